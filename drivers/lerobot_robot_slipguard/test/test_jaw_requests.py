"""What a gripper position means: only a long, explicit opening after a closing releases."""

from __future__ import annotations

from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from lerobot_robot_slipguard.jaw_requests import JawRequest, JawRequests

STROKE_MM = 80.0
DT_S = 1 / 30


def state(phase: str = "idle", width_mm: float = 80.0, force_n: float = 0.0, **changes: Any) -> dict[str, Any]:
    """Return a daemon's state, as far as it counts here."""
    holding = phase in ("holding", "reference", "lifting", "fault")
    gripper = {"width_mm": width_mm, "force_n": force_n, "moving": False, "holding": holding}
    made = {"phase": phase, "fault": None, "target_force_n": force_n, "limits": {"force_max_n": 100.0}}
    return made | {"gripper": gripper | {"closed_on_nothing": False}} | changes


def run(
    openings: list[float], at: dict[str, Any], jaws: JawRequests | None = None, force_n: float | None = None
) -> list[JawRequest | None]:
    """Return the requests of actions at 30 Hz in one state."""
    jaws = jaws or JawRequests(STROKE_MM, release_above=0.9, release_after_s=0.3)
    return [jaws.next(opening, force_n, at, index * DT_S) for index, opening in enumerate(openings)]


def releases(requests: list[JawRequest | None]) -> int:
    return sum(request is not None and request.kind == "release" for request in requests)


HELD = state("holding", width_mm=40.0, force_n=30.0)


def test_empty_jaws_follow_the_position_and_are_commanded_once() -> None:
    first, *rest = run([0.5] * 10, state(width_mm=40.0))
    assert first == JawRequest("gripper", {"width_mm": 40.0})
    assert not any(rest)
    sent = [request.fields["width_mm"] for request in run([1.0, 0.9, 0.8, 0.0], state()) if request]
    assert sent == pytest.approx([80.0, 72.0, 64.0, 0.0])


def test_jaws_that_missed_the_position_are_commanded_again_twice_per_second() -> None:
    assert sum(request is not None for request in run([0.5] * 60, state(width_mm=80.0))) == 4


def test_a_long_opening_after_a_closing_releases_once() -> None:
    requests = run([0.0] + [1.0] * 60, HELD)
    assert releases(requests) == 1
    (at,) = (index for index, request in enumerate(requests) if request)
    assert at * DT_S == pytest.approx(0.3 + DT_S, abs=DT_S)
    assert requests[at] == JawRequest("release", {"confirm": True, "width_mm": 80.0})


@pytest.mark.parametrize(
    "openings",
    [
        [1.0] * 300,  # the policy commands open jaws, and another client gripped
        [0.0] + [0.9] * 300,  # at the threshold is not above it
        [0.0, *([1.0] * 9 + [0.5]) * 30],  # interrupted
        [0.0, 1.0] * 150,  # jitter over the whole range
    ],
    ids=["never closed", "at the threshold", "interrupted", "jitter"],
)
def test_anything_less_keeps_the_grip(openings: list[float]) -> None:
    assert not any(run(openings, HELD))


def test_noise_around_closed_never_releases() -> None:
    generator = np.random.default_rng(0)
    openings = np.clip(0.3 + 0.4 * generator.standard_normal(20_000), 0.0, 1.0).tolist()
    above = [before > 0.9 and after > 0.9 for before, after in pairwise(openings)]
    assert any(above), "the noise crosses the threshold, also twice in a row"
    assert not any(run(openings, HELD))


@pytest.mark.parametrize("phase", ["closing", "released", "fault"])
def test_nothing_is_sent_while_slipguard_moves_the_jaws_or_during_a_fault(phase: str) -> None:
    fault = {"code": "object lost", "observed": "", "what_to_do": ""} if phase == "fault" else None
    assert not any(run([0.0] + [1.0] * 60, state(phase, fault=fault)))


def test_the_time_above_the_threshold_starts_again_with_each_object() -> None:
    jaws = JawRequests(STROKE_MM, 0.9, 0.3)
    run([0.0, 1.0, 1.0], HELD, jaws)
    run([1.0], state(), jaws)
    assert releases(run([1.0] * 60, HELD, jaws)) == 0, "the next object was not closed on by this policy"


def test_after_a_fault_the_jaws_are_closed_before_an_opening_counts() -> None:
    jaws = JawRequests(STROKE_MM, 0.9, 0.3)
    run([0.0], HELD, jaws)
    run([1.0] * 30, state("fault", fault={"code": "frames lost"}), jaws)
    assert releases(run([1.0] * 60, HELD, jaws)) == 0, "a person has cleared the fault; the policy still says open"
    assert releases(run([0.0] + [1.0] * 60, HELD, jaws)) == 1


def test_force_only_rises_and_stays_within_the_limit() -> None:
    assert run([0.0], HELD, force_n=20.0) == [None]
    assert run([0.0], HELD, force_n=50.0) == [JawRequest("gripper", {"force_n": 50.0})]
    assert run([0.0], HELD, force_n=500.0) == [JawRequest("gripper", {"force_n": 100.0})]


def test_a_silent_gripper_gets_nothing() -> None:
    assert run([0.0, 1.0], state(gripper=None)) == [None, None]
