"""The periods of a periodic texture are counted from frame to frame; after a gap the rotation is ambiguous."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from slipguard.daemon.loop.finger import Finger, TimedEstimate
from slipguard.datasets.rendered_grasps import bench_object
from slipguard.devices import Frame
from slipguard.perception.contact.patch import find_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.declined import DeclineReason
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.fusion import SLIP_SHARE
from slipguard.perception.rotation.period_count import (
    ACCELERATION_DEG_S2,
    PERIODIC_SHARE,
    possible_rotation_deg,
    repeats_after_deg,
)
from slipguard.perception.rotation.texture_map import TextureMapReader
from slipguard.perception.rotation.texture_template import make_texture_template
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import UNCHANGED
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit
from slipguard.stress.product_functions import FRAME_S, ScriptedSegmenter
from slipguard.stress.textured_surfaces import (
    Heights,
    LedLights,
    Surface,
    contact_map,
    gear,
    heights,
    lettered,
    nut,
    plate,
    shaded_image,
)

BACKGROUND = np.full((320, 240, 3), 100, np.uint8)


AT = (120.0, 160.0)


def polygon(corners: int) -> Surface:
    """A face with a number of corners."""
    normals = [2.0 * math.pi * k / corners for k in range(corners)]

    def surface(u: Heights, v: Heights) -> Heights:
        sides = np.max([u * math.cos(a) + v * math.sin(a) for a in normals], axis=0)
        return np.asarray(9.0 * np.exp(-(np.maximum(sides - 26.0, 0.0) ** 2) / 100.0), np.float32)

    return surface


def toothed(teeth: int) -> Surface:
    """The rim of a cap with a number of teeth."""

    def surface(u: Heights, v: Heights) -> Heights:
        ribs = 3.0 * np.cos(teeth * np.arctan2(v, u)) * np.exp(-((np.hypot(u, v) - 42.0) ** 2) / 120.0)
        return np.asarray(9.0 * np.exp(-((np.hypot(u, v) - 38.0) ** 2) / 400.0) + ribs, np.float32)

    return surface


def oblong_gear(u: Heights, v: Heights) -> Heights:
    """Teeth on a long hump, whose axis identifies the tooth."""
    away = np.hypot(np.maximum(np.abs(u) - 30.0, 0.0), np.maximum(np.abs(v) - 10.0, 0.0))
    ribs = 3.0 * np.cos(12 * np.arctan2(v, u)) * np.exp(-((np.hypot(u, v) - 32.0) ** 2) / 120.0)
    return np.asarray(9.0 * np.exp(-away * away / 1800.0) + ribs, np.float32)


@pytest.mark.parametrize(
    ("surface", "repeats_deg"),
    [(gear, 30.0), (nut, 60.0), (polygon(3), 120.0), (polygon(4), 90.0), (polygon(5), 72.0), (lettered, None),
     (plate, None)],
)  # fmt: skip
def test_the_period_of_periodic_textures(surface: Surface, repeats_deg: float | None) -> None:
    height = heights(surface, 20.0, AT, 1.0)
    image = shaded_image(height, LedLights(), 2.0, np.random.default_rng(1))
    patch = find_patch(contact_map(height), 0.5, 100, 2.0)
    assert patch is not None
    reader = TextureMapReader(BACKGROUND)
    reader.learn(image, patch)
    texture = make_texture_template(reader.read(image, patch), patch)
    assert texture is not None
    (found,) = repeats_after_deg(texture, PERIODIC_SHARE)
    assert found == (None if repeats_deg is None else pytest.approx(repeats_deg, abs=2.0))


@pytest.mark.parametrize(
    ("name", "repeats"),
    [("cap", True), ("wrench", False), ("bar", False), ("hook", False), ("key", False), ("wedge", False),
     ("knife_edge", False), ("screwdriver", False)],
)  # fmt: skip
def test_of_the_test_objects_only_the_ribbed_ones_are_periodic(name: str, repeats: bool) -> None:
    pipe = rendered(name, 3)[0]
    reference = pipe._meter.reference
    assert reference is not None
    assert reference.texture is not None
    assert reference.texture.periods.repeats == repeats


def test_possible_rotation_in_a_gap() -> None:
    assert possible_rotation_deg(0.0, 300.0) == 0.0
    assert possible_rotation_deg(-1.0, 300.0) == 0.0
    assert possible_rotation_deg(0.01, -300.0) == pytest.approx(3.0)
    assert possible_rotation_deg(0.1, 0.0) == pytest.approx(0.5 * ACCELERATION_DEG_S2 * 0.01)


class Held:
    """A drawn surface before the whole pipeline, at times of its own."""

    def __init__(self, surface: Surface) -> None:
        self._segmenter = ScriptedSegmenter()
        settings = PerceptionSettings(reference="first", skip_unchanged=False)
        self.pipe = Pipeline(self._segmenter, settings, BACKGROUND, None, 18.5)
        self._surface = surface
        self._frames = 0
        self.now_s = 0.0

    def see(self, rotation_deg: float, after_s: float = FRAME_S) -> Estimate:
        self._frames += 1
        self.now_s += after_s
        height = heights(self._surface, 15.0 + rotation_deg, AT, 1.0)
        self._segmenter.map = contact_map(height)
        image = shaded_image(height, LedLights(), 2.0, np.random.default_rng(self._frames))
        return self.pipe.process(Frame(image, self.now_s, self._frames))


@pytest.mark.parametrize(
    ("surface", "gap_s", "rotation_deg"),
    [(gear, 0.1, 22.0), (nut, 0.145, 50.0), (nut, 2.0, 44.0), (polygon(4), 2.0, 75.0), (polygon(5), 0.145, 50.0)],
)
def test_a_gap_long_enough_for_a_period_makes_the_rotation_ambiguous(
    surface: Surface, gap_s: float, rotation_deg: float
) -> None:
    held = Held(surface)
    for _ in range(3):
        assert held.see(0.0).rotation_deg == pytest.approx(0.0, abs=0.5)
    after = [held.see(rotation_deg, gap_s), *(held.see(rotation_deg) for _ in range(10))]
    assert {one.decline_reason for one in after} == {DeclineReason.PERIOD_AMBIGUOUS}
    assert {one.rotation_deg for one in after} == {None}


@pytest.mark.parametrize("surface", [gear, nut, lettered])
def test_one_or_two_lost_frames_are_bridged(surface: Surface) -> None:
    held = Held(surface)
    for _ in range(3):
        held.see(0.0)
    assert held.see(4.0, 2.0 * FRAME_S).rotation_deg == pytest.approx(4.0, abs=0.5)
    assert held.see(8.0, 2.0 * FRAME_S).rotation_deg == pytest.approx(8.0, abs=0.5)


def test_other_textures_are_measured_after_any_gap() -> None:
    held = Held(lettered)
    for _ in range(3):
        held.see(0.0)
    after = [held.see(8.0, 5.0), held.see(8.0), held.see(8.0)]
    assert after[2].rotation_deg == pytest.approx(8.0, abs=0.5)


@pytest.mark.parametrize(
    ("gap_s", "on_deg", "measured"), [(0.045, 14.0, True), (0.045, 0.0, False), (0.09, 28.0, False)]
)
def test_a_fast_rotation_may_have_stopped_in_a_gap(gap_s: float, on_deg: float, measured: bool) -> None:
    held = Held(gear)
    rotations = [0.0, 0.0, *(6.0 * k for k in range(1, 7))]
    assert held.see(0.0).rotation_deg is not None
    assert [held.see(rotation).rotation_deg for rotation in rotations] == pytest.approx(rotations, abs=0.5)
    after = held.see(rotations[-1] + on_deg, gap_s).rotation_deg
    assert after == (pytest.approx(rotations[-1] + on_deg, abs=0.5) if measured else None)


def test_one_lost_frame_is_bridged_for_fine_teeth() -> None:
    """A cap with 26 teeth; at 30 Hz it can rotate by a tooth in a lost frame."""
    held = Held(toothed(26))
    for _ in range(3):
        assert held.see(0.0, 1.0 / 30.0).rotation_deg == pytest.approx(0.0, abs=0.5)
    assert held.see(0.0, 2.0 / 60.0).rotation_deg == pytest.approx(0.0, abs=0.5)
    assert held.see(0.5, 2.0 / 60.0).rotation_deg == pytest.approx(0.5, abs=0.5)
    assert held.see(0.5, 2.0 / 30.0).declined == DeclineReason.PERIOD_AMBIGUOUS


@pytest.mark.parametrize("acceleration_deg_s2", [300.0, 7_500.0, 12_000.0, 20_000.0])
def test_no_tooth_is_miscounted_while_a_rotation_accelerates(acceleration_deg_s2: float) -> None:
    """24 teeth at 60 Hz without a lost frame; the rotation begins at any moment between two frames."""
    measured = 0
    for begin in (0.2, 0.7):
        held = Held(toothed(24))
        for _ in range(4):
            held.see(0.0)
        for k in range(1, 10):
            truth_deg = 0.5 * acceleration_deg_s2 * ((k - begin) * FRAME_S) ** 2
            found = held.see(truth_deg)
            if found.rotation_deg is not None and found.sigma_deg is not None:
                measured += 1
                assert abs(found.rotation_deg - truth_deg) < 4.0 * found.sigma_deg + 0.05
    assert measured >= (18 if acceleration_deg_s2 < 1_000.0 else 2)


def test_a_jump_of_nearly_half_a_period_is_declined_for_that_frame_only() -> None:
    held = Held(gear)
    for _ in range(3):
        held.see(0.0)
    assert held.see(13.0).declined == DeclineReason.PERIOD_AMBIGUOUS
    assert held.see(0.0).rotation_deg == pytest.approx(0.0, abs=0.5)
    assert [held.see(13.0).declined for _ in range(6)] == [DeclineReason.PERIOD_AMBIGUOUS] * 6


def test_a_kept_estimate_bridges_a_gap() -> None:
    measured = {}
    for kept in (True, False):
        held = Held(gear)
        for _ in range(3):
            held.see(0.0)
        for k in range(1, 13):
            if kept:
                held.pipe.keep_estimate(held.now_s + k * FRAME_S)
        measured[kept] = held.see(0.5, 13.0 * FRAME_S)
    assert measured[True].rotation_deg == pytest.approx(0.5, abs=0.3)
    assert measured[False].declined == DeclineReason.PERIOD_AMBIGUOUS


def test_a_finger_that_the_daemon_skips_stays_unambiguous() -> None:
    held = Held(gear)
    shown = [held.see(0.0) for _ in range(3)][-1]
    none = cast(Any, None)  # no frame comes of a sensor here, and none goes to a worker
    finger, other = (
        Finger(name, none, none, lambda _: held.pipe, 1.0, none, lambda: None) for name in ("left", "right")
    )
    finger.skip_frames_after(other, 0.25)
    finger.newest = TimedEstimate(shown, shown.captured_at_s, shown.captured_at_s)
    frame_image = np.zeros((320, 240, 3), np.uint8)
    for k in range(1, 13):
        at_s = held.now_s + k * FRAME_S
        other.newest = TimedEstimate(replace(shown, captured_at_s=at_s, skipped=UNCHANGED), at_s, at_s)
        repeated = finger._kept_estimate(Frame(frame_image, at_s, k), held.pipe)
        assert repeated is not None
        finger.newest = TimedEstimate(repeated, at_s, at_s)
    assert held.see(0.5, 13.0 * FRAME_S).rotation_deg == pytest.approx(0.5, abs=0.3)


def test_a_kept_estimate_does_not_resolve_an_ambiguity() -> None:
    held = Held(gear)
    for _ in range(3):
        held.see(0.0)
    held.pipe.keep_estimate(held.now_s + 1.0)
    assert held.see(0.0, 1.0 + FRAME_S).declined == DeclineReason.PERIOD_AMBIGUOUS


def test_an_axis_resolves_the_ambiguity() -> None:
    held = Held(oblong_gear)
    for _ in range(3):
        held.see(0.0)
    reference = held.pipe._meter.reference
    assert reference is not None
    assert reference.texture is not None
    assert reference.texture.periods.period_deg == pytest.approx(30.0, abs=2.0)
    after = [held.see(40.0, 2.0), held.see(42.0), held.see(44.0), held.see(46.0)]
    assert [one.decline_reason for one in after[:2]] == [DeclineReason.REGAINED] * 2
    assert [one.rotation_deg for one in after[2:]] == pytest.approx([44.0, 46.0], abs=0.5)


def rendered(name: str, seed: int) -> tuple[Pipeline, GelCamera, GelView, int]:
    """A bench object in a rendered sensor, its reference taken on the last of 6 frames."""
    thing, height_map = bench_object(name)
    assert height_map is None
    rng = np.random.default_rng(seed)
    unit = random_unit(rng)
    camera = GelCamera(unit, seed=seed)
    background = camera.no_contact()
    x_mm, y_mm, start_deg = rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-180, 180)
    view = GelView(name, x_mm, y_mm, start_deg, 0.6 * thing.press_mm)
    pipe = Pipeline(Segmenter(), PerceptionSettings(), background, unit.noise_bgr, unit.px_per_mm)
    for k in range(6):
        pipe.process(Frame(camera.draw(view), k * FRAME_S, k))
    return pipe, camera, view, 6


@pytest.mark.parametrize(("seed", "rotation_deg"), [(1, 15.0), (1, -22.0), (2, 30.0), (4, 30.0)])
def test_a_texture_searched_in_the_wrong_place_is_found_near_the_contour(seed: int, rotation_deg: float) -> None:
    pipe, camera, view, frames = rendered("hook", seed)
    rotated = GelView(view.object_name, view.x_mm, view.y_mm, view.angle_deg + rotation_deg, view.depth_mm)
    for k in range(3):
        last_estimate = pipe.process(Frame(camera.draw(rotated), (frames + k) * FRAME_S + 0.1, frames + k))
        assert last_estimate.rotation_deg == pytest.approx(rotation_deg, abs=2.0)
        assert last_estimate.sigma_deg is not None
        assert last_estimate.sigma_deg < 0.6 + SLIP_SHARE * abs(rotation_deg)
