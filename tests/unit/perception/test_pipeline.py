"""From a frame to an estimate: signs, the reference, contact that comes and goes, input that is not valid."""

from __future__ import annotations

import itertools
import math

import cv2
import numpy as np
import pytest
from held_finger import BACKGROUND, CENTER, FRAME_S, PX_PER_MM, START_DEG, DrawnContact, DrawnFinger, RenderedFinger
from numpy.typing import NDArray
from textured_surfaces import LedLights, Surface, ball, lettered, plate, ring

from slipguard.devices import Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.perception.axis import axial_difference_deg
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import Skips


def assert_within(estimate: Estimate, true_deg: float, sigma_max_deg: float = 1.5) -> None:
    """Assert that an estimate is right, and certain."""
    assert estimate.rotation_deg is not None, estimate.declined
    assert estimate.sigma_deg is not None
    assert estimate.sigma_deg < sigma_max_deg
    assert abs(estimate.rotation_deg - true_deg) < 4.0 * estimate.sigma_deg + 0.05


@pytest.mark.parametrize("surface", [lettered, plate])
@pytest.mark.parametrize("rotation_deg", [12.0, -45.0])
def test_rotations_are_counter_clockwise_and_cross_90_degrees(surface: Surface, rotation_deg: float) -> None:
    finger = DrawnFinger(surface)
    finger.rest(6, 70.0)
    for part in np.linspace(0.0, 1.0, 12):
        last = finger.see(70.0 + part * rotation_deg)
        assert_within(last, part * rotation_deg)
    assert last.contact
    assert last.method == "registration"
    assert last.rate_deg_s == pytest.approx(rotation_deg / 11 / FRAME_S, rel=0.1)
    if surface is plate:
        assert last.orientation_deg is not None
        assert -90.0 < last.orientation_deg <= 90.0
        assert abs(axial_difference_deg(last.orientation_deg, START_DEG + 70.0 + rotation_deg)) < 1.0


@pytest.mark.parametrize("surface", [lettered, plate])
def test_a_full_revolution_is_unwrapped(surface: Surface) -> None:
    finger = DrawnFinger(surface)
    finger.rest()
    for k in range(1, 46):
        last = finger.see(8.0 * k)
        assert_within(last, 8.0 * k)
    assert last.rate_deg_s == pytest.approx(480.0, rel=0.05)


@pytest.mark.parametrize(
    ("mounting_deg", "shift_mm", "orientation_deg"),
    [(0, (0.5, 1.0), 25), (90, (-1.0, 0.5), -65), (180, (-0.5, -1.0), 25), (270, (1.0, -0.5), -65)],
)
def test_mounting_rotates_directions_but_not_rotations(
    mounting_deg: int, shift_mm: tuple[float, float], orientation_deg: float
) -> None:
    finger = DrawnFinger(plate, mounting_deg=mounting_deg)
    finger.rest()
    for part in (0.5, 1.0):
        moved = finger.see(10.0 * part, at=(CENTER[0] + part * 0.5 * PX_PER_MM, CENTER[1] - part * PX_PER_MM))
    assert_within(moved, 10.0)
    assert moved.shift_mm == pytest.approx(shift_mm, abs=0.05)
    assert moved.orientation_deg == pytest.approx(orientation_deg, abs=1.0)


def test_the_reference_is_the_first_stable_contact() -> None:
    finger = DrawnFinger(lettered)
    growing = [finger.see(0.0, force=0.5 + 0.1 * k) for k in range(5)]
    assert not finger.pipeline.has_reference
    assert {one.declined for one in growing} == {"no reference yet"}
    stable = finger.rest(5)
    assert finger.pipeline.has_reference
    assert finger.pipeline.reference_image is not None
    assert finger.pipeline.carried_deg == 0.0
    assert_within(stable, 0.0)
    assert stable.contact_radius_mm is not None
    assert math.pi * (PX_PER_MM * stable.contact_radius_mm) ** 2 == pytest.approx(stable.contact_area_px)


@pytest.mark.parametrize("name", ["wrench", "key", "hook"])
def test_a_growing_contact_has_a_reference_after_a_tenth_of_a_second(name: str) -> None:
    """Rotations count from there."""
    finger = RenderedFinger(name, 3)
    for k in range(40):
        last = finger.see(max(k - 6, 0), deeper=min(0.15 + 0.03 * k, 1.0))
        if k > 7:
            assert_within(last, k - 6, 2.5)


def test_a_reference_taken_while_the_contact_grows_is_replaced_by_a_later_one() -> None:
    finger = RenderedFinger("wedge", 3)
    for k in range(20):
        last = finger.see(max(k - 6, 0), deeper=0.15 + 0.03 * k)
        if k == 7:
            first_image = finger.pipeline.reference_image
        if k > 7 and last.segmented:
            assert_within(last, k - 6, 2.5)
    assert first_image is not None
    assert finger.pipeline.reference_image is not first_image
    assert finger.pipeline.carried_deg > 3.0


def test_the_reference_may_be_the_first_contact() -> None:
    finger = DrawnFinger(lettered, reference="first")
    assert_within(finger.see(0.0), 0.0)
    assert_within(finger.see(6.0), 6.0)


def test_a_new_reference_starts_at_zero() -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    assert_within(finger.see(10.0), 10.0)
    finger.pipeline.reset_reference()
    assert not finger.pipeline.has_reference
    assert finger.pipeline.reference_image is None
    assert_within(finger.rest(6, 10.0), 0.0)


@pytest.mark.parametrize("surface", [ball, ring])
def test_a_round_contact_is_declined_and_its_shift_measured(surface: Surface) -> None:
    finger = DrawnFinger(surface)
    finger.rest()
    moved = finger.see(25.0, at=(138.5, 123.0))
    assert moved.contact
    assert moved.decline_reason == "round contact"
    assert (moved.rotation_deg, moved.sigma_deg, moved.rate_deg_s) == (None, None, None)
    assert moved.shift_mm == pytest.approx((1.0, 2.0), abs=0.05)


def test_without_contact_the_network_does_not_run() -> None:
    finger = DrawnFinger(None)
    for _ in range(5):
        last = finger.see(0.0)
        assert (last.contact, last.skipped, last.declined) == (False, "no contact", "no contact")
        assert (last.contact_area_px, last.contact_radius_mm, last.rotation_deg) == (0, None, None)
        assert last.measured_at_s == last.captured_at_s
    assert finger.network.calls == 0
    assert not finger.pipeline.last_mask.any()
    assert finger.pipeline.last_patch is None


def test_a_contact_that_leaves_and_returns_keeps_its_reference() -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    finger.surface = None
    assert not any(finger.see(0.0).contact for _ in range(4))
    finger.surface = lettered
    assert_within(finger.rest(3, 8.0), 8.0)


@pytest.mark.parametrize("gain", [0.8, 1.25])
def test_a_change_of_the_light_is_no_rotation(gain: float) -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    for _ in range(4):
        finger.now_s += FRAME_S
        drawn = finger.draw(5.0)
        image = np.clip(100.0 + gain * (drawn.image.astype(np.float32) - 100.0) + 4.0, 0, 255).astype(np.uint8)
        assert_within(finger.pipeline.process(Frame(image, finger.now_s, finger.frames)), 5.0)


def test_lights_of_another_order_and_strength_are_learned() -> None:
    for lights in (LedLights((1.0, 0.6, 1.5)), LedLights(azimuths_deg=(270.0, 30.0, 150.0))):
        finger = DrawnFinger(lettered, lights=lights)
        finger.rest()
        for k in range(1, 9):
            assert_within(finger.see(3.0 * k), 3.0 * k)


def test_a_corrupt_frame_is_an_error_and_changes_nothing() -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    assert_within(finger.see(3.0), 3.0)
    with pytest.raises(FrameCorrupt) as caught:
        finger.pipeline.process(Frame(np.full((240, 320, 3), 90, np.uint8), finger.now_s + 0.01, 99))
    assert "\n" not in str(caught.value)
    assert_within(finger.see(6.0), 6.0)


@pytest.mark.parametrize("level", [0, 255])
def test_a_black_or_white_frame_shows_nothing_and_the_next_one_is_measured(level: int) -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    estimate = finger.pipeline.process(Frame(np.full((320, 240, 3), level, np.uint8), finger.now_s + 0.01, 99))
    assert estimate.unusable
    assert estimate.rotation_deg is None
    assert_within(finger.see(6.0), 6.0)


@pytest.mark.parametrize("gain", [0.05, 0.1])
def test_a_dark_frame_is_declined_or_right_and_the_next_one_measured(gain: float) -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    finger.now_s += FRAME_S
    dark = Frame(np.asarray(np.rint(gain * finger.draw(3.0).image), np.uint8), finger.now_s, finger.frames)
    seen = finger.pipeline.process(dark)
    assert seen.rotation_deg is None or abs(seen.rotation_deg - 3.0) < 4.0 * (seen.sigma_deg or 0.0)
    assert_within(finger.see(6.0), 6.0)


def test_a_map_that_is_not_a_number_is_no_contact() -> None:
    finger = DrawnFinger(lettered)
    drawn = finger.draw(0.0)
    finger.network.map = np.full((160, 120), np.nan, np.float32)
    assert not finger.pipeline.process(drawn).contact


@pytest.mark.parametrize("at_s", [math.nan, math.inf, -math.inf])
def test_a_frame_without_a_capture_time_is_an_error(at_s: float) -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    with pytest.raises(FrameCorrupt, match="no capture time"):
        finger.pipeline.process(Frame(finger.draw(3.0).image, at_s, 99))
    assert_within(finger.see(6.0), 6.0)


def test_irregular_times_give_the_same_rotations_and_finite_rates() -> None:
    finger = DrawnFinger(lettered)
    finger.rest()
    rng = np.random.default_rng(5)
    late_s = [0.0, 1e-9, -0.004, *rng.uniform(0.002, 0.03, 9), -0.3, 1e-9]
    for k, after_s in enumerate(late_s, 1):
        last = finger.see(2.0 * k, after_s)
        assert_within(last, 2.0 * k)
        assert last.rate_deg_s is None or math.isfinite(last.rate_deg_s)
    for k in range(9):
        last = finger.see(28.0 + k)
    assert last.rate_deg_s == pytest.approx(60.0, rel=0.05)


def test_a_mask_of_noise_gives_no_certain_rotation() -> None:
    rng = np.random.default_rng(8)
    finger = DrawnFinger(lettered, reference="first", skip_unchanged=False)
    certain = []
    for k in range(30):
        drawn = finger.draw(0.0)
        blobs = cv2.GaussianBlur(rng.random((160, 120)).astype(np.float32), (0, 0), rng.uniform(2, 8))
        blobs = np.asarray((blobs - blobs.min()) / (blobs.max() - blobs.min()), np.float32)
        finger.network.map = np.asarray(blobs > 0.55, np.float32)
        image = np.asarray(rng.integers(60, 140, (320, 240, 3)), np.uint8)
        image = cv2.GaussianBlur(image, (0, 0), 3.0)
        last = finger.pipeline.process(Frame(np.asarray(image), k * FRAME_S, drawn.sequence))
        if k and last.sigma_deg is not None and last.sigma_deg < 2.0:
            certain.append(k)
    assert len(certain) <= 1


def test_the_mask_is_that_of_the_last_frame_and_finer_than_the_network() -> None:
    finger = DrawnFinger(plate)
    finger.see(30.0)
    mask, patch = finger.pipeline.last_mask, finger.pipeline.last_patch
    assert mask.shape == (320, 240)
    assert set(np.unique(mask)) == {0, 1}
    assert patch is not None
    true = cv2.resize(finger.network.map, (240, 320), interpolation=cv2.INTER_CUBIC) > 0.5
    doubled = patch.full_mask().repeat(2, axis=0).repeat(2, axis=1)
    assert np.count_nonzero(mask != true) < 0.5 * np.count_nonzero(doubled != true)


def test_stage_times_come_from_the_injected_timer() -> None:
    ticks = itertools.count()
    finger = DrawnFinger(lettered)
    pipeline = Pipeline(
        finger.network,
        PerceptionSettings(),
        BACKGROUND,
        None,
        PX_PER_MM,
        timer=lambda: 0.001 * next(ticks),
        skips=Skips(whole=False),
    )
    for k in range(7):
        last = pipeline.process(Frame(finger.draw(float(k)).image, k * FRAME_S, k))
    assert set(last.stage_ms) == {"gate", "segment", "regions", "relief", "track"}
    assert all(value == pytest.approx(round(value)) and value > 0.9 for value in last.stage_ms.values())
    assert finger.see(0.0).stage_ms == {}


@pytest.mark.parametrize(
    ("background", "px_per_mm", "mounting_deg", "says"),
    [
        (BACKGROUND, PX_PER_MM, 45, "0, 90, 180 or 270"),
        (BACKGROUND, 0.0, 0, "px_per_mm"),
        (BACKGROUND, math.nan, 0, "px_per_mm"),
        (BACKGROUND[:10], PX_PER_MM, 0, "background image"),
    ],
)
def test_an_invalid_setting_is_one_line(
    background: NDArray[np.uint8], px_per_mm: float, mounting_deg: int, says: str
) -> None:
    with pytest.raises(InputError, match=says) as caught:
        Pipeline(DrawnContact(), PerceptionSettings(), background, None, px_per_mm, mounting_deg)
    assert "\n" not in str(caught.value)
