"""From a frame to an estimate, with a segmenter that reads the contact from the blue channel."""

from __future__ import annotations

import dataclasses
import itertools
import math
from typing import cast

import cv2
import numpy as np
import pytest
from blue_contact import BACKGROUND, ReadsBlue, frame
from drawn_masks import drawn
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.perception.contact.patch import resize_mask_to_frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.axial_angle import axial_difference_deg
from slipguard.perception.rotation.skeleton import middle_line
from slipguard.perception.settings import EstimatorName, PerceptionSettings
from slipguard.perception.skipping import Skips

ESTIMATORS: tuple[EstimatorName, ...] = ("fused", "registration", "moments", "ellipse", "pca", "skeleton")


class ReadsNaN(ReadsBlue):
    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        return np.full((160, 120), np.nan, np.float32)


def pipeline(mounting_deg: int = 0, segmenter: ReadsBlue | None = None, **settings: object) -> Pipeline:
    return Pipeline(
        segmenter or ReadsBlue(),
        PerceptionSettings(**settings),  # type: ignore[arg-type]
        BACKGROUND,
        (1.0, 1.0, 1.0),
        18.5,
        mounting_deg,
    )


def run(pipe: Pipeline, shape: str, angles: list[float], start: int = 0) -> list[Estimate]:
    return [pipe.process(frame(drawn(shape, a, ragged_px=0.2, seed=k), k)) for k, a in enumerate(angles, start)]


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize(("before", "now", "rotation"), [(-6, 6, 12), (80, 100, 20), (10, -35, -45)])
def test_rotations_are_signed_and_cross_90_degrees(
    estimator: EstimatorName, before: float, now: float, rotation: float
) -> None:
    steps = list(np.linspace(before, now, 12))
    last = run(pipeline(estimator=estimator), "bar", [before] * 6 + steps)[-1]
    assert last.rotation_deg == pytest.approx(rotation, abs=1.0)
    assert last.orientation_deg is not None
    assert -90 < last.orientation_deg <= 90
    assert abs(axial_difference_deg(last.orientation_deg, now)) < 1.0
    assert last.method == estimator


def test_a_full_revolution_is_unwrapped() -> None:
    last = run(pipeline(), "key", [0.0] * 5 + [4.0 * k for k in range(1, 91)])[-1]
    assert last.rotation_deg == pytest.approx(360.0, abs=1.5)
    assert last.rate_deg_s == pytest.approx(240.0, rel=0.1)


def test_the_reference_is_the_first_stable_contact() -> None:
    pipe = pipeline()
    growing = [pipe.process(frame(drawn("bar", 20, scale=0.5 + 0.1 * k), k)) for k in range(6)]
    assert not pipe.has_reference
    assert {e.declined for e in growing} == {"no reference yet"}
    still = run(pipe, "bar", [20.0] * 6, start=6)
    assert pipe.has_reference
    assert still[-1].rotation_deg == pytest.approx(0.0, abs=0.3)
    assert pipe._meter.reference is not None
    assert pipe._meter.reference.patch.area_px == pytest.approx(still[-1].contact_area_px, rel=0.05)
    assert math.pi * (18.5 * still[-1].contact_radius_mm) ** 2 == pytest.approx(still[-1].contact_area_px)


def test_rotations_while_the_force_grows_count_from_the_first_tenth_of_a_second() -> None:
    pipe = pipeline()
    for k in range(40):
        rotation = 0.5 * max(k - 5, 0)
        estimate = pipe.process(frame(drawn("bar", 20 + rotation, scale=0.4 + 0.02 * k), k))
        if k == 6:
            assert pipe.has_reference
    assert estimate.rotation_deg == pytest.approx(16.5, abs=0.5)
    assert pipe._meter.reference is not None
    assert pipe._meter.reference.patch.area_px > 2000  # it follows while the contact grows from 1,800 px
    since_it_deg = pipe._meter._tracker._last[1]
    assert pipe.carried_deg > 1.0
    assert pipe.carried_deg + since_it_deg == pytest.approx(estimate.rotation_deg, abs=1e-6)


def test_the_reference_may_be_the_first_contact() -> None:
    pipe = pipeline(reference="first")
    first, second = run(pipe, "bar", [20.0, 26.0])
    assert first.rotation_deg == pytest.approx(0.0, abs=0.2)
    assert second.rotation_deg == pytest.approx(6.0, abs=0.7)


def test_a_new_reference_starts_at_zero() -> None:
    pipe = pipeline()
    run(pipe, "bar", [0.0] * 5 + [10.0] * 5)
    pipe.reset_reference()
    assert not pipe.has_reference
    assert pipe.reference_image is None
    assert run(pipe, "bar", [10.0] * 6, start=20)[-1].rotation_deg == pytest.approx(0.0, abs=0.4)


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("shape", ["disc", "ring"])
def test_round_contacts_are_declined_but_their_shift_is_measured(estimator: EstimatorName, shape: str) -> None:
    pipe = pipeline(estimator=estimator)
    run(pipe, shape, [0.0] * 6)
    moved = pipe.process(frame(drawn(shape, 25, (69.25, 61.5)), 9))
    assert moved.contact
    assert moved.rotation_deg is None
    assert moved.sigma_deg is None
    assert moved.rate_deg_s is None
    assert moved.declined
    assert moved.shift_mm == pytest.approx((1.0, 2.0), abs=0.05)


@pytest.mark.parametrize(
    ("mounting_deg", "shift_mm", "orientation_deg"),
    [(0, (0.5, 1.0), 30), (90, (-1.0, 0.5), -60), (180, (-0.5, -1.0), 30), (270, (1.0, -0.5), -60)],
)
def test_mounting_rotates_directions_but_not_rotations(
    mounting_deg: int, shift_mm: tuple[float, float], orientation_deg: float
) -> None:
    pipe = pipeline(mounting_deg)
    run(pipe, "bar", [20.0] * 6)
    moved = pipe.process(frame(drawn("bar", 30, (64.625, 70.75)), 9))
    assert moved.rotation_deg == pytest.approx(10.0, abs=0.8)
    assert moved.shift_mm == pytest.approx(shift_mm, abs=0.15)
    assert moved.orientation_deg == pytest.approx(orientation_deg, abs=1.0)


def test_no_contact_needs_no_network() -> None:
    segmenter = ReadsBlue()
    pipe = pipeline(segmenter=segmenter)
    for k in range(5):
        last_estimate = pipe.process(frame(None, k))
        assert (last_estimate.contact, last_estimate.skipped, last_estimate.declined) == (
            False,
            "no contact",
            "no contact",
        )
        assert last_estimate.contact_area_px == 0
        assert last_estimate.measured_at_s == last_estimate.captured_at_s
    assert segmenter.calls == 0
    assert not pipe.last_mask.any()
    assert pipe.last_patch is None


def test_an_unchanged_image_repeats_the_estimate_for_at_most_a_quarter_second() -> None:
    segmenter = ReadsBlue()
    pipe = pipeline(segmenter=segmenter)
    frame_image = drawn("bar", 20)
    estimates = [pipe.process(frame(frame_image, k)) for k in range(180)]
    measured = sum(one.skipped is None for one in estimates)
    assert segmenter.calls < measured / 2  # the texture shows that the contact is the same
    assert 36 <= measured <= 60  # half a second to be sure of the rest, then four a second
    reused = [a for a in estimates if a.skipped]
    assert {a.skipped for a in reused} == {"unchanged"}
    assert all(0.0 < a.captured_at_s - a.measured_at_s < 0.25 for a in reused)
    assert [a.sequence for a in estimates] == list(range(180))
    assert all(a.contact and a.rotation_deg is not None for a in estimates[6:])
    rotated = pipe.process(frame(drawn("bar", 21.5), 180))
    assert rotated.skipped is None
    assert rotated.rotation_deg == pytest.approx(1.5, abs=0.4)


@pytest.mark.parametrize("knock", [3.0, 70.0])
def test_after_a_glitch_of_one_frame_the_estimate_is_that_of_the_image(knock: float) -> None:
    pipe = pipeline()
    for k in range(90):
        pipe.process(frame(drawn("bar", 20), k))
    struck = pipe.process(frame(drawn("bar", 20 + knock), 90))
    assert struck.skipped is None
    after = [pipe.process(frame(drawn("bar", 20), k)) for k in range(91, 121)]
    assert after[0].skipped is None
    assert {last_estimate.skipped for last_estimate in after} == {None, "unchanged"}
    assert [last_estimate.rotation_deg for last_estimate in after] == pytest.approx([0.0] * 30, abs=0.5)
    assert [last_estimate.rate_deg_s for last_estimate in after[10:]] == pytest.approx([0.0] * 20, abs=2.0)


def test_a_slow_rotation_is_measured_within_half_a_degree_despite_skips() -> None:
    pipe = pipeline()
    run(pipe, "bar", [20.0] * 6)
    for k in range(6, 90):
        true = 0.05 * (k - 5)
        last_estimate = pipe.process(frame(drawn("bar", 20.0 + true), k))
        assert last_estimate.rotation_deg == pytest.approx(true, abs=0.5)


def test_skipping_can_be_switched_off() -> None:
    segmenter = ReadsBlue()
    pipe = pipeline(segmenter=segmenter, skip_unchanged=False)
    run(pipe, "bar", [20.0] * 20)
    assert segmenter.calls < 20
    always = Skips(whole=False)
    pipe = Pipeline(
        segmenter, PerceptionSettings(skip_unchanged=False), BACKGROUND, (1.0, 1.0, 1.0), 18.5, skips=always
    )
    calls = segmenter.calls
    run(pipe, "bar", [20.0] * 20)
    assert segmenter.calls - calls == 20


def test_a_flipped_axis_is_not_a_rotation() -> None:
    pipe = pipeline(estimator="moments")
    run(pipe, "rectangle", [0.0] * 6)
    flipped = pipe.process(frame(drawn("rectangle", 90), 7))
    assert flipped.rotation_deg is None
    assert flipped.decline_reason in ("implausible jump", "too uncertain")


def test_contact_lost_and_found_keeps_its_reference() -> None:
    pipe = pipeline()
    run(pipe, "bar", [0.0] * 6)
    for k in range(6, 10):
        assert not pipe.process(frame(None, k)).contact
    assert run(pipe, "bar", [8.0] * 3, start=10)[-1].rotation_deg == pytest.approx(8.0, abs=0.7)


def test_mask_and_skeleton_are_those_of_the_last_frame() -> None:
    pipe = pipeline()
    run(pipe, "bar", [30.0] * 2)
    assert pipe.last_patch is not None
    line = middle_line(pipe.last_patch)
    skeleton = resize_mask_to_frame(dataclasses.replace(pipe.last_patch, mask=line.skeleton).full_mask())
    mask = pipe.last_mask
    assert mask.shape == skeleton.shape == (320, 240)
    assert set(np.unique(mask)) == {0, 1}
    assert skeleton.any()
    assert not (skeleton & ~mask & 1).any()


def test_the_mask_is_finer_than_the_networks_pixels() -> None:
    pipe = pipeline()
    shape = drawn("bar", 30.0)
    pipe.process(frame(shape, 0))
    true = cv2.resize(shape, (240, 320)) > 0.6 / 1.1  # half of what `ReadsBlue` makes of it
    assert pipe.last_patch is not None
    doubled = pipe.last_patch.full_mask().repeat(2, axis=0).repeat(2, axis=1)
    assert np.count_nonzero(pipe.last_mask != true) < 0.5 * np.count_nonzero(doubled != true)


def test_stage_times_come_from_the_injected_timer() -> None:
    ticks = itertools.count()
    settings, always = PerceptionSettings(), Skips(whole=False)
    timer = lambda: 0.001 * next(ticks)  # noqa: E731
    pipe = Pipeline(ReadsBlue(), settings, BACKGROUND, None, 18.5, timer=timer, skips=always)
    estimates = [pipe.process(frame(drawn("bar", 20 + k), k)) for k in range(8)]
    assert set(estimates[-1].stage_ms) == {"gate", "segment", "regions", "relief", "angle", "track"}
    assert all(value == pytest.approx(round(value)) and value > 0.9 for value in estimates[-1].stage_ms.values())
    assert pipeline().process(frame(drawn("bar", 20), 0)).stage_ms == {}


def test_values_that_are_not_finite_are_rejected() -> None:
    last_estimate = pipeline(segmenter=ReadsNaN()).process(frame(drawn("bar"), 0))
    assert not last_estimate.contact
    for at in (float("nan"), float("inf")):
        with pytest.raises(FrameCorrupt, match="no capture time"):
            pipeline().process(frame(drawn("bar"), 0, captured_at_s=at))


def test_a_noise_mask_gives_no_certain_rotation() -> None:
    rng = np.random.default_rng(8)
    pipe = pipeline(reference="first", skip_unchanged=False)
    certain = []
    for k in range(60):
        blobs = cv2.GaussianBlur(rng.random((160, 120)).astype(np.float32), (0, 0), rng.uniform(2, 8))
        blobs = ((blobs - blobs.min()) / (blobs.max() - blobs.min()) > 0.55).astype(np.float32)
        last_estimate = pipe.process(frame(blobs, k))
        if k and last_estimate.rotation_deg is not None and cast("float", last_estimate.sigma_deg) < 2.0:
            certain.append(k)
    assert len(certain) <= 3


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"mounting_deg": 45}, "0, 90, 180 or 270"),
        ({"px_per_mm": 0.0}, "px_per_mm"),
        ({"background": 0}, "background image"),
    ],
)
def test_an_invalid_setting_is_one_line(change: dict[str, float], says: str) -> None:
    background = BACKGROUND[:10] if "background" in change else BACKGROUND
    with pytest.raises(InputError, match=says) as caught:
        Pipeline(
            ReadsBlue(),
            PerceptionSettings(),
            background,
            None,
            change.get("px_per_mm", 18.5),
            int(change.get("mounting_deg", 0)),
        )
    assert "\n" not in str(caught.value)


def test_a_corrupt_frame_changes_nothing() -> None:
    pipe = pipeline()
    before = run(pipe, "bar", [0.0] * 6)[-1]
    with pytest.raises(FrameCorrupt):
        pipe.process(Frame(np.zeros((320, 240, 3), np.uint8), 0.2, 7))
    after = pipe.process(frame(drawn("bar", 0.0, ragged_px=0.2, seed=5), 8))
    assert dataclasses.replace(after, sequence=0, captured_at_s=0, measured_at_s=0, skipped=None).rotation_deg == (
        pytest.approx(before.rotation_deg, abs=0.4)
    )


def test_a_contact_that_does_not_change_is_measured_without_the_network() -> None:
    segmenter = ReadsBlue()
    pipe = pipeline(segmenter=segmenter, skip_unchanged=False)
    run(pipe, "key", [20.0] * 6)
    calls = segmenter.calls
    seen = run(pipe, "key", [20.0] * 28, start=6)
    assert segmenter.calls - calls <= 20  # drawn and ragged: its texture is faint
    assert sum(one.segmented for one in seen) == segmenter.calls - calls
    assert [one.rotation_deg for one in seen] == pytest.approx([0.0] * 28, abs=0.7)
    assert [one.measured_at_s for one in seen] == [one.captured_at_s for one in seen]


@pytest.mark.parametrize("change", ["second contact", "growth", "leap", "none left"])
def test_a_contact_that_changes_is_segmented_in_the_same_frame(change: str) -> None:
    segmenter = ReadsBlue()
    pipe = pipeline(segmenter=segmenter)
    run(pipe, "key", [20.0] * 8)
    calls = segmenter.calls
    shape = drawn("key", 20)
    changed = {
        "second contact": np.maximum(shape, drawn("disc", 0, (20.0, 140.0), scale=0.4)),
        "growth": drawn("key", 20, scale=1.25),
        "leap": drawn("key", 35),
        "none left": None,
    }[change]
    seen = pipe.process(frame(changed, 8))
    assert segmenter.calls == calls + (change != "none left")
    assert seen.contact is (change != "none left")
