"""Numbers that are none, clocks that go back and pictures of something else give no turn instead of a wrong one."""

from __future__ import annotations

import math

import numpy as np
import pytest
from drawn_masks import SHAPES, drawn
from numpy.typing import NDArray
from observations import estimate as said

from slipguard.control.finger_fusion import fuse
from slipguard.devices import Frame
from slipguard.perception.contact.gate import DEFAULT_NOISE_BGR, block_means, blocks_near
from slipguard.perception.contact.patch import find_patch, ragged_px
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.declined import DeclineReason
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.quality.image_quality import ImageQuality
from slipguard.perception.rotation.axis import estimate_axis
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.rotation_tracker import RATE_STALE_S, RotationTracker
from slipguard.perception.settings import PerceptionSettings
from slipguard.stress.image_distortions import DISTORTIONS
from slipguard.stress.image_families import rotated_grasp


def rotating(tracker: RotationTracker, from_s: float, rate_deg_s: float, frames: int) -> float | None:
    """The rate after so many regular frames of a steady turn."""
    for k in range(frames):
        tracker.accept(from_s + k / 60, RotationEstimate(rate_deg_s * k / 60, 0.3))
    return tracker.rate_deg_s(from_s + (frames - 1) / 60)


@pytest.mark.parametrize("back_s", [1e-9, 0.01, 0.1, 50.0, 1e6])
def test_the_rate_is_right_again_after_the_clock_went_back(back_s: float) -> None:
    tracker = RotationTracker()
    tracker.start(1e6)
    rotating(tracker, 1e6, 0.0, 20)
    assert rotating(tracker, 1e6 + 19 / 60 - back_s, 60.0, 12) == pytest.approx(60.0, abs=1.0)


def test_frames_a_nanosecond_apart_tell_no_rate() -> None:
    tracker = RotationTracker()
    tracker.start(5.0)
    for k in range(10):
        tracker.accept(5.0 + k * 1e-9, RotationEstimate(0.1 * (-1) ** k, 0.1))
    assert tracker.rate_deg_s(5.0 + RATE_STALE_S / 2) is None


@pytest.mark.parametrize(
    "bad",
    [
        RotationEstimate(math.nan, 1.0),
        RotationEstimate(1.0, math.nan),
        RotationEstimate(math.inf, 1.0),
        RotationEstimate(1.0, math.inf),
    ],
)
def test_the_tracker_takes_no_turn_that_is_no_number(bad: RotationEstimate) -> None:
    tracker = RotationTracker()
    tracker.start(0.0)
    assert tracker.accept(0.1, bad).declined == "not a number"
    assert tracker.last_rotation_deg == 0.0


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("field", ["angle_deg", "sigma_deg", "rate_deg_s"])
def test_a_finger_whose_numbers_are_none_tells_no_turn(field: str, bad: float) -> None:
    values = {"angle_deg": 10.0, "sigma_deg": 0.5, "rate_deg_s": 0.0, field: bad}
    fused = fuse(said(**values), said(-12.0, rate_deg_s=0.0))  # type: ignore[arg-type]
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(12.0)
    assert fused.fingers == ("right",)
    assert fused.note == "left finger: not a number"
    assert fused.left_contact


def test_a_finger_without_a_time_says_nothing() -> None:
    fused = fuse(said(10.0, at_s=math.nan), said(-12.0))
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(12.0)
    assert fused.left_contact is None
    assert fuse(said(10.0, at_s=math.inf), None) is None


def test_a_shift_that_is_no_number_is_left_out() -> None:
    fused = fuse(said(10.0, shift_mm=(0.0, math.nan)), said(-10.0, shift_mm=(0.0, -0.5)))
    assert fused is not None
    assert fused.shift_mm == pytest.approx(0.5)


def test_a_finger_that_knows_no_rate_turns_at_the_others() -> None:
    fused = fuse(said(10.0, at_s=1.0, rate_deg_s=100.0), said(-12.0, at_s=1.02))
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(10.0)
    assert fused.fingers == ("left", "right")


def test_without_any_rate_the_older_finger_is_left_out() -> None:
    fused = fuse(said(10.0, at_s=1.0), said(-30.0, at_s=1.05))
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(30.0)
    assert fused.fingers == ("right",)
    assert fused.note == "left finger: 50 ms behind"


@pytest.mark.parametrize("beyond", [3e38, -3e38, math.inf, -math.inf, math.nan])
def test_probabilities_beyond_0_and_1_weigh_no_more_than_these(beyond: float) -> None:
    clean = drawn("bar", 30.0)
    spoiled = clean.copy()
    spoiled[np.random.default_rng(0).random(clean.shape) < 0.02] = beyond
    patch = find_patch(spoiled, 0.5, 200, 2.0)
    assert patch is not None
    assert patch.probability.min() >= 0.0
    assert patch.probability.max() <= 1.0
    assert estimate_axis(patch, "moments").angle_deg == pytest.approx(30.0, abs=2.0)


def fits(quality: ImageQuality, blocks: NDArray[np.float32], near: NDArray[np.bool_]) -> bool:
    return math.isfinite(quality.difference_levels(blocks, near))


def whole_frame() -> NDArray[np.uint8]:
    return np.random.default_rng(1).integers(90, 100, (320, 240, 3), np.uint8)


def test_a_contact_that_fills_the_picture_shows_no_outline() -> None:
    gate = ImageQuality(None)
    blocks = block_means(whole_frame())
    mask = np.ones((160, 120), np.uint8)
    assert not fits(gate, blocks, blocks_near(mask))
    mask[:, :40] = 0
    assert fits(gate, blocks, blocks_near(mask))


def test_light_may_drift_but_the_picture_must_be_the_units_own() -> None:
    background = whole_frame()
    gate = ImageQuality(background)
    near = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((60, 60), (40, 40))))
    brighter = background + np.uint8(20)
    assert fits(gate, block_means(brighter), near)
    pressed = background.copy()
    pressed[130:190, 90:150] = 240
    assert fits(gate, block_means(pressed), near)
    other = background.copy()
    other[:, :120] += np.uint8(40)
    assert not fits(gate, block_means(other), near)


@pytest.mark.parametrize("order", [(2, 1, 0), (1, 0, 2), (0, 2, 1), (1, 2, 0), (2, 0, 1)])
def test_swapped_colours_are_seen_even_under_a_large_contact(order: tuple[int, int, int]) -> None:
    shown = rotated_grasp(2)
    gate = ImageQuality(shown.background)
    near = blocks_near(np.pad(np.ones((120, 100), np.uint8), ((20, 20), (10, 10))))
    for image in shown.frames:
        assert fits(gate, block_means(image), near)
        assert not fits(gate, block_means(np.ascontiguousarray(image[..., order])), near)


@pytest.mark.parametrize("level", [0, 255])
def test_a_contact_under_a_glare_or_a_dead_spot_shows_no_outline(level: int) -> None:
    spotted = whole_frame()
    spotted[150:200, 110:160] = level
    near = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((60, 60), (40, 40))))
    away = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((10, 110), (10, 70))))
    gate = ImageQuality(spotted)
    assert not fits(gate, block_means(spotted), near)
    assert fits(gate, block_means(spotted), away)


def test_light_that_changes_after_the_reference_makes_turns_less_certain() -> None:
    shown = rotated_grasp(2)
    slope = np.linspace(-9.0, 9.0, 320)[:, None, None]

    def last(tilt: float) -> tuple[float, float]:
        pipeline = Pipeline(Segmenter(), PerceptionSettings(), shown.background, None, 18.5)
        for k, image in enumerate(shown.frames[:8]):
            lit = image if k < 6 else np.clip(image + tilt * slope, 0, 255).astype(np.uint8)
            answer = pipeline.process(Frame(lit, k / 60, k))
        assert answer.angle_deg is not None
        assert answer.sigma_deg is not None
        return answer.angle_deg, answer.sigma_deg

    (_, steady), (rotated, tilted) = last(0.0), last(1.0)
    assert tilted > steady + 0.5
    assert abs(rotated - shown.rotations_deg[7]) < 3.0 * tilted


def test_a_turn_in_an_almost_dark_picture_is_measured_not_skipped() -> None:
    shown = rotated_grasp(0)
    dark = [np.asarray(image // 16, np.uint8) for image in shown.frames]
    background = np.asarray(shown.background // 16, np.uint8)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, DEFAULT_NOISE_BGR, 18.5)
    answers = [pipeline.process(Frame(image, k / 60, k)) for k, image in enumerate(dark)]
    assert not [one for one in answers if one.contact and one.skipped]


@pytest.mark.parametrize("noise", [2.0, 32.0])
def test_a_camera_that_has_become_far_too_noisy_is_unlike(noise: float) -> None:
    background = np.full((320, 240, 3), 100, np.uint8)
    rng = np.random.default_rng(0)
    noisy = np.clip(background + noise * rng.standard_normal(background.shape), 0, 255).astype(np.uint8)
    near = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((60, 60), (40, 40))))
    assert fits(ImageQuality(background), block_means(noisy), near) == (noise < 10.0)


@pytest.mark.parametrize(("levels", "fit"), [(6, True), (20, True), (45, False)])
def test_light_may_change_evenly_only_so_far(levels: int, fit: bool) -> None:
    background = whole_frame()
    lamp = background.copy()
    lamp[..., 1] += np.uint8(levels)
    near = blocks_near(np.pad(np.ones((40, 40), np.uint8), ((60, 60), (40, 40))))
    assert fits(ImageQuality(background), block_means(lamp), near) == fit


@pytest.mark.parametrize(("what", "strength"), [("swapped colors", 1.0), ("negative", 0.5), ("crushed", 0.5)])
def test_a_camera_with_another_light_tells_no_turn_and_takes_no_reference(what: str, strength: float) -> None:
    shown = rotated_grasp(0)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), shown.background, None, 18.5)
    rng = np.random.default_rng(0)
    answers = [
        pipeline.process(Frame(DISTORTIONS[what](image, strength, rng), k / 60, k))
        for k, image in enumerate(shown.frames)
    ]
    assert {answer.decline_reason for answer in answers if answer.contact} <= {DeclineReason.UNLIKE_BACKGROUND}
    assert not [answer for answer in answers if answer.angle_deg is not None]
    assert not pipeline.has_reference
    clean = [pipeline.process(Frame(image, (20 + k) / 60, 20 + k)) for k, image in enumerate(shown.frames)]
    assert clean[-1].angle_deg == pytest.approx(shown.rotations_deg[-1], abs=3.0)


@pytest.mark.parametrize("shape", SHAPES)
def test_the_outlines_of_objects_are_not_ragged(shape: str) -> None:
    for angle in (0, 20, 65):
        patch = find_patch(drawn(shape, angle, ragged_px=0.3), 0.5, 200, 2.0)
        assert patch is not None
        assert patch.ragged_px < 0.4


@pytest.mark.parametrize("shape", ["bar", "rectangle", "ellipse"])
def test_ragged_outlines_make_every_estimator_less_certain(shape: str) -> None:
    for seed in range(4):
        clean = find_patch(drawn(shape, 25.0), 0.5, 200, 2.0)
        rough = find_patch(drawn(shape, 25.0, ragged_px=3.0, seed=seed), 0.5, 200, 2.0)
        assert clean is not None
        assert rough is not None
        assert rough.ragged_px > 0.8
        for name in ("moments", "pca", "ellipse"):
            sure, unsure = estimate_axis(clean, name).sigma_deg, estimate_axis(rough, name).sigma_deg
            assert sure is not None
            assert unsure is None or unsure > 2.0 * sure


def test_a_mask_in_many_pieces_is_ragged_all_over() -> None:
    mask = np.zeros((160, 120), np.uint8)
    mask[::4, ::4] = 1
    assert ragged_px(mask) > 3.0
    assert ragged_px(np.zeros((5, 5), np.uint8)) == 0.0


@pytest.mark.parametrize("name", ["moments", "pca", "ellipse", "fused"])
def test_a_ring_cut_by_the_frame_is_no_axis(name: str) -> None:
    for seed, x in enumerate((8.0, 14.0, 20.0, 24.0)):
        patch = find_patch(drawn("ring", 0.0, (x, 80.0), ragged_px=0.3, seed=seed), 0.5, 200, 2.0)
        assert patch is not None
        assert patch.clipped.left
        assert estimate_axis(patch, name).declined
