"""The second finger is skipped while the other one sees no change; no slip is detected later because of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from slip_onset import SlipWatch

from slipguard.control.finger_fusion import fuse
from slipguard.perception.estimate import Estimate
from slipguard.perception.skipping import OTHER_FINGER, repeat_estimate, second_finger_can_skip

REFRESH_S = 0.25


def estimate_of(sigma_deg: float | None, at_s: float = 1.0, skipped: str | None = None, **changes: object) -> Estimate:
    said = Estimate(
        sequence=60,
        captured_at_s=at_s,
        measured_at_s=at_s,
        contact=True,
        contact_area_px=5000,
        method="registration",
        rotation_deg=None if sigma_deg is None else 0.0,
        sigma_deg=sigma_deg,
        rate_deg_s=None if sigma_deg is None else 0.0,
        shift_mm=(0.0, 0.0),
        skipped=skipped,
        declined="round contact" if sigma_deg is None else None,
    )
    return replace(said, **changes)  # type: ignore[arg-type]


CERTAIN = estimate_of(0.3, 1.02, "unchanged")


CERTAIN_LATER = replace(CERTAIN, captured_at_s=1.24)


def test_a_less_certain_or_declined_finger_is_skipped() -> None:
    for own in (
        estimate_of(0.5),
        estimate_of(0.3),
        estimate_of(None),
        estimate_of(0.5, rotation_deg=1.5),
        estimate_of(0.3, rotation_deg=1.0),
    ):
        assert second_finger_can_skip(own, CERTAIN, 1.02, REFRESH_S)
    assert second_finger_can_skip(
        estimate_of(0.3, rotation_deg=8.0), replace(CERTAIN, rotation_deg=-8.0), 1.02, REFRESH_S
    )
    assert second_finger_can_skip(estimate_of(0.5, captured_at_s=1.235), CERTAIN_LATER, 1.24, REFRESH_S)


@pytest.mark.parametrize(
    ("own", "other", "at_s"),
    [
        (estimate_of(0.2), CERTAIN, 1.02),
        (estimate_of(0.5), replace(CERTAIN, skipped=None), 1.02),
        (estimate_of(0.5), replace(CERTAIN, skipped=OTHER_FINGER), 1.02),
        (estimate_of(0.5), replace(CERTAIN, contact=False), 1.02),
        (estimate_of(0.5), replace(CERTAIN, captured_at_s=0.9), 1.02),
        (estimate_of(0.5), estimate_of(None, 1.02, "unchanged"), 1.02),
        (estimate_of(0.5), CERTAIN, 1.26),
        (estimate_of(0.5, captured_at_s=1.225), CERTAIN_LATER, 1.24),
        (estimate_of(0.3, rotation_deg=1.5), CERTAIN, 1.02),
        (estimate_of(0.3, rotation_deg=-1.5), CERTAIN, 1.02),
        (estimate_of(0.5), CERTAIN, 0.9),
        (estimate_of(0.5, contact=False), CERTAIN, 1.02),
        (estimate_of(0.5, shift_mm=None), CERTAIN, 1.02),
        (None, CERTAIN, 1.02),
        (estimate_of(0.5), None, 1.02),
        (estimate_of(0.5), CERTAIN, float("nan")),
    ],
)
def test_a_finger_that_may_add_information_is_measured(
    own: Estimate | None, other: Estimate | None, at_s: float
) -> None:
    assert not second_finger_can_skip(own, other, at_s, REFRESH_S)


@given(st.floats(0.1, 5.0), st.floats(0.1, 5.0))
def test_two_fingers_never_skip_each_other(left_deg: float, right_deg: float) -> None:
    left, right = estimate_of(left_deg, 1.0, "unchanged"), estimate_of(right_deg, 1.0, "unchanged")
    repeated = second_finger_can_skip(left, right, 1.016, REFRESH_S)
    if repeated:
        left = repeat_estimate(left, 1.016, 61)
        assert left.skipped == OTHER_FINGER
        assert left.measured_at_s == 1.0
    assert not (repeated and second_finger_can_skip(right, left, 1.016, REFRESH_S))


def first_slip(rate_deg_s: float, skip_second: bool, phase_s: float) -> int:
    """Frame on which the controller detects the slip; the right finger comes second, with twice the noise."""
    rng = np.random.default_rng(3)
    watch = SlipWatch()
    left: Estimate | None = None
    right: Estimate | None = None
    history: list[float] = []
    for k in range(2000):
        at_s = k / 60
        moved = max(at_s - 1.0 - phase_s, 0.0) * rate_deg_s
        noise = rng.normal(0.0, 1.0, 2)
        history.append(moved)
        rate = 60.0 * (history[-1] - history[-7]) / 6 if len(history) > 6 else 0.0
        rests = moved < 0.3 and k % 15 != 0  # what the gate sees is far less than the level of a slip
        if rests and left is not None:
            left = replace(left, captured_at_s=at_s, skipped="unchanged")
        else:
            left = estimate_of(0.1, at_s, rotation_deg=moved + 0.1 * noise[0], rate_deg_s=rate)
        if skip_second and second_finger_can_skip(right, left, at_s, REFRESH_S) and right is not None:
            right = repeat_estimate(right, at_s, k)
        else:
            right = estimate_of(0.2, at_s, rotation_deg=-moved + 0.2 * noise[1], rate_deg_s=-rate)
        fused = fuse(left, right)
        assert fused is not None
        assert at_s - fused.measured_at_s < REFRESH_S + 1e-9
        if watch.slips(fused):
            return k
    raise AssertionError("never seen")


@pytest.mark.parametrize("rate_deg_s", [0.5, 2.0, 8.0, 40.0, 300.0])
@pytest.mark.parametrize("phase_s", [0.0, 0.1, 0.2])
def test_a_slip_is_detected_at_most_one_frame_later(rate_deg_s: float, phase_s: float) -> None:
    noise = round(60 * 0.05 / rate_deg_s)  # frames in which the object rotates by as much
    assert first_slip(rate_deg_s, True, phase_s) <= first_slip(rate_deg_s, False, phase_s) + 1 + noise
