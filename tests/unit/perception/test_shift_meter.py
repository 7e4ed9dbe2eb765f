"""The shift of the object at the grasp axis; along ribs and threads it is ambiguous, and a slide is still seen."""

from __future__ import annotations

import math
from functools import cache

import pytest
from held_finger import PX_PER_MM, DrawnFinger, RenderedFinger
from textured_surfaces import lettered, plate

from slipguard.perception.estimate import DeclineReason, Estimate
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.shaft import Shaft


@cache
def shaft_raster(pitch_mm: float, threaded: bool) -> HeightRaster:
    if pitch_mm:
        return Shaft(pitch_mm=pitch_mm, groove_mm=0.25 * pitch_mm, threaded=threaded).raster()
    return Shaft(end_mm=4.0).raster()


def shaft(pitch_mm: float = 0.0, threaded: bool = False, seed: int = 3) -> RenderedFinger:
    """Return a finger that holds an upright shaft at rest. pitch_mm: of its ribs; 0: smooth, with an end."""
    finger = RenderedFinger("shaft", seed, shaft_raster(pitch_mm, threaded), depth=0.5, angle_deg=85.0)
    finger.rest(12)
    return finger


def accelerated(finger: RenderedFinger, mm_s2: float, frames: int = 6) -> list[tuple[float, Estimate]]:
    """Return how far a shaft has slid and the estimate, by frame."""
    seen = []
    for k in range(frames):
        slid_mm = 0.5 * mm_s2 * (k / 60.0) ** 2
        seen.append((slid_mm, finger.see(0.0, slid_mm=slid_mm, mm_s=mm_s2 * k / 60.0)))
    return seen


@pytest.mark.parametrize("seed", [3, 4])
@pytest.mark.parametrize(
    ("pitch_mm", "threaded", "mm_s2"), [(0.8, False, 300.0), (0.8, False, 9_000.0), (1.25, True, 3_000.0)]
)
def test_a_slide_of_a_ribbed_shaft_is_seen_and_its_shift_is_ambiguous(
    pitch_mm: float, threaded: bool, mm_s2: float, seed: int
) -> None:
    seen = accelerated(shaft(pitch_mm, threaded, seed), mm_s2)
    for slid_mm, one in seen:
        assert one.shift_mm is None
        assert one.shift_declined is not None
        reason, _, by = one.shift_declined.partition(": by ")
        assert reason == DeclineReason.SHIFT_AMBIGUOUS
        assert float(by.split()[0]) == pytest.approx(pitch_mm, rel=0.1)
        assert one.slides is (slid_mm > 0.25 * pitch_mm)
    assert seen[-1][1].slides


def test_a_ribbed_shaft_at_rest_does_not_slide() -> None:
    finger = shaft(2.0)
    assert not any(finger.see(0.0).slides for _ in range(12))


@pytest.mark.parametrize("seed", [3, 4])
def test_a_slide_of_a_smooth_shaft_shows_at_its_end(seed: int) -> None:
    finger = shaft(seed=seed)
    for slid_mm in (0.0, 0.3, 1.25, 5.0):
        one = finger.see(0.0, slid_mm=slid_mm)
        assert one.shift_mm is not None
        assert one.shift_mm[1] == pytest.approx(-slid_mm, abs=0.5)


@pytest.mark.parametrize("name", ["wrench", "key", "wedge", "bar", "knife_edge", "hook"])
def test_other_objects_have_a_shift(name: str) -> None:
    finger = RenderedFinger(name, 3)
    assert finger.rest(12).shift_mm == pytest.approx((0.0, 0.0), abs=0.1)
    for slid_mm in (0.2, 0.4):
        one = finger.see(0.0, slid_mm=slid_mm)
    assert one.shift_mm == pytest.approx((0.0, -0.4), abs=0.15)
    assert one.shift_declined is None


@pytest.mark.parametrize("surface", [lettered, plate])
@pytest.mark.parametrize("above_mm", [0.0, 3.0])
def test_an_object_that_rotates_about_the_grasp_axis_does_not_slide(surface: object, above_mm: float) -> None:
    """The contact lies above the axis, and moves on a circle about it."""
    finger = DrawnFinger(surface)  # type: ignore[arg-type]
    radius_px = above_mm * PX_PER_MM
    for k in range(26):
        rotation_deg, slid_px = min(max(k - 5, 0), 15), 3.0 * max(k - 20, 0)
        angle = math.radians(rotation_deg)
        one = finger.see(
            rotation_deg, at=(119.5 - radius_px * math.sin(angle), 159.5 - radius_px * math.cos(angle) - slid_px)
        )
        if k > 5:
            assert one.shift_mm == pytest.approx((0.0, slid_px / PX_PER_MM), abs=0.1)
