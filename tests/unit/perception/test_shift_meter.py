"""Slides of ribbed, threaded and smooth shafts: no wrong shift is reported, and the slip detector sees the slide."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from slipguard.control.finger_fusion import fuse
from slipguard.control.params import GuardParams
from slipguard.control.slip_detector import assess_slip
from slipguard.control.slip_memory import SlipMemory
from slipguard.datasets.rendered_grasps import bench_object
from slipguard.devices import Frame
from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.declined import DeclineReason
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.shift_meter import ShiftMeter, end_offset_px
from slipguard.perception.rotation.texture_tracker import TrackedTexture
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.sensor_unit import random_unit
from slipguard.sim.shaft import Shaft

FRAME_S = 1.0 / 60.0
REST_FRAMES = 12
LENGTH_MM = 30.0


@cache
def shaft_raster(pitch_mm: float, threaded: bool) -> HeightRaster:
    if pitch_mm:
        return Shaft(pitch_mm=pitch_mm, groove_mm=0.25 * pitch_mm, threaded=threaded).raster()
    return Shaft(end_mm=4.0).raster()


class Finger:
    """A finger that holds an upright shaft, or another object."""

    def __init__(self, raster: HeightRaster | None, seed: int, name: str = "shaft", depth_mm: float = 0.5) -> None:
        rng = np.random.default_rng(seed)
        unit = random_unit(rng)
        self._camera, self._raster, self._name, self._depth_mm = GelCamera(unit, seed=seed), raster, name, depth_mm
        self._x_mm, self._angle_deg = rng.uniform(-1.0, 1.0), 90.0 + rng.uniform(-8.0, 8.0)
        background = self._camera.no_contact()
        self._pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, unit.noise_bgr, unit.px_per_mm)
        self._frames = 0

    def see(self, slid_mm: float, mm_s: float = 0.0) -> Estimate:
        view = GelView(self._name, self._x_mm, -slid_mm, self._angle_deg, self._depth_mm, vy_mm_s=-mm_s)
        self._frames += 1
        image = self._camera.draw(view, raster=self._raster)
        return self._pipeline.process(Frame(image, self._frames * FRAME_S, self._frames))


@pytest.mark.parametrize(
    ("pitch_mm", "threaded", "mm_s2", "seen_mm"),
    [(0.8, False, 300.0, 1.1), (0.8, False, 9_000.0, 5.1), (1.25, True, 3_000.0, 1.7), (2.0, False, 9_000.0, 5.1)],
)
def test_a_slide_of_a_ribbed_shaft_is_seen_and_its_shift_is_declined(
    pitch_mm: float, threaded: bool, mm_s2: float, seen_mm: float
) -> None:
    raster = shaft_raster(pitch_mm, threaded)
    fingers = Finger(raster, 3), Finger(raster, 4)
    memory, seen_at_mm = SlipMemory(), None
    for k in range(-REST_FRAMES, 12):
        at_s = max(k, 0) * FRAME_S
        slid_mm = min(0.5 * mm_s2 * at_s**2, LENGTH_MM)
        left, right = (finger.see(slid_mm, mm_s2 * at_s) for finger in fingers)
        for one in (left, right):
            if one.shift_mm is not None:  # the frame that becomes the reference
                assert one.shift_mm == pytest.approx((0.0, 0.0), abs=1e-6)
            if one.shift_declined is not None:
                reason, _, by = one.shift_declined.partition(": by ")
                assert reason == DeclineReason.SHIFT_AMBIGUOUS
                assert float(by.split()[0]) == pytest.approx(pitch_mm, rel=0.1)
        fused = fuse(left, right)
        assert fused is not None
        assessed = assess_slip(memory, fused, GuardParams())
        memory = assessed.memory
        if assessed.slipping and seen_at_mm is None:
            seen_at_mm = slid_mm
            assert "slides by an unknown distance" in assessed.what
    assert seen_at_mm is not None
    assert 0.0 < seen_at_mm <= seen_mm


def test_a_fast_slide_of_a_smooth_shaft_shows_at_its_end() -> None:
    fingers = Finger(shaft_raster(0.0, False), 3), Finger(shaft_raster(0.0, False), 4)
    memory, seen_at_mm = SlipMemory(), None
    for slid_mm in (*([0.0] * REST_FRAMES), 1.25, 5.0, 11.25):
        fused = fuse(fingers[0].see(slid_mm), fingers[1].see(slid_mm))
        assert fused is not None
        assessed = assess_slip(memory, fused, GuardParams())
        memory = assessed.memory
        if assessed.slipping and seen_at_mm is None:
            seen_at_mm = slid_mm
            assert assessed.slip_mm == pytest.approx(slid_mm, abs=1.0)
    assert seen_at_mm is not None
    assert seen_at_mm <= 5.0


@pytest.mark.parametrize("name", ["wrench", "key", "wedge", "bar", "knife_edge", "hook"])
def test_other_objects_have_a_shift(name: str) -> None:
    finger = Finger(None, 3, name, 0.6 * bench_object(name)[0].press_mm)
    last = [finger.see(0.0) for _ in range(REST_FRAMES)][-1]
    assert last.shift_mm is not None
    assert last.shift_mm == pytest.approx((0.0, 0.0), abs=0.1)


@pytest.mark.parametrize(
    ("declined", "slides"),
    [
        (f"{DeclineReason.CONTACT_CHANGED}: correlation 0.3", True),
        (f"{DeclineReason.DEFORMED}: 3 deg", False),
        (str(DeclineReason.GEL_MEMORY), False),
        (str(DeclineReason.PERIOD_AMBIGUOUS), False),
        (None, False),
    ],
)
def test_a_periodic_texture_slides_when_it_has_changed_beyond_recognition(declined: str | None, slides: bool) -> None:
    meter, patch = ShiftMeter(None, bar_patch(40, 100)), bar_patch(40, 100)
    meter.period = (0.0, 8.0)
    rest = TrackedTexture(RotationEstimate(0.0, 0.5), 1.0, (0.0, 0.0))
    assert not meter.measure(1.0, patch, rest, (0.0, 0.0)).slides
    gone = None if declined is None else TrackedTexture(RotationEstimate(None, None, declined), 1.0)
    assert meter.measure(1.02, patch, gone, (0.0, 0.0)).slides is slides


def test_the_shift_is_that_of_the_grasp_axis_wherever_the_contact_lies() -> None:
    patch = bar_patch(10, 40)  # 111 frame pixels above the image center
    meter = ShiftMeter(None, bar_patch(10, 40))
    assert meter.at_axis(meter.measure(1.0, patch, None, (1.0, 2.0)), 0.0).shift_px == (1.0, 2.0)
    up_px = 159.5 - patch.center_px[1]
    moved = (-up_px * math.sin(math.radians(20.0)), up_px * (1.0 - math.cos(math.radians(20.0))))
    shift = meter.at_axis(meter.measure(1.1, patch, None, (moved[0] + 3.0, moved[1] - 2.0)), 20.0)
    assert shift.shift_px == pytest.approx((3.0, -2.0), abs=0.5)


@pytest.mark.parametrize(("name", "seed"), [("wedge", 9), ("screwdriver", 5)])
def test_an_object_that_rotates_about_the_grasp_axis_does_not_slide(name: str, seed: int) -> None:
    unit = random_unit(np.random.default_rng(seed))
    camera = GelCamera(unit, seed=seed)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), camera.no_contact(), unit.noise_bgr, unit.px_per_mm)
    depth_mm = 0.6 * bench_object(name)[0].press_mm
    for k in range(REST_FRAMES + 20):
        view = GelView(name, angle_deg=40.0 + max(k - REST_FRAMES, 0), depth_mm=depth_mm)
        estimate = pipeline.process(Frame(camera.draw(view), k * FRAME_S, k))
        if k > REST_FRAMES:
            assert estimate.shift_mm == pytest.approx((0.0, 0.0), abs=0.3)
    assert estimate.rotation_deg == pytest.approx(19.0, abs=1.0)


def bar_patch(from_row: int, to_row: int) -> Patch:
    probability = np.zeros((160, 120), np.float32)
    probability[from_row:to_row, 50:70] = 1.0
    patch = find_patch(probability, 0.5, 100, 2.0)
    assert patch is not None
    return patch


@pytest.mark.parametrize(
    ("rows", "offset_px"), [((50, 160), 20.0), ((0, 120), 40.0), ((45, 115), 20.0), ((0, 160), None)]
)
def test_the_visible_ends_show_how_far_a_contact_has_moved(rows: tuple[int, int], offset_px: float | None) -> None:
    reference = bar_patch(40, 100)
    found = end_offset_px(reference, bar_patch(*rows), (0.0, 0.0), (0.0, 1.0), 0.0)
    assert found == (None if offset_px is None else pytest.approx(offset_px, abs=8.0))
