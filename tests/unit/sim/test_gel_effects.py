"""Tilt, twist, shear, memory and domes change the imprint as in mechanics; without them nothing changes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_effects import GelEffects, GelMemory
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.imprint import Imprinter
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.sim.shaft import Shaft
from slipguard.sim.shapes import grooves

GRAY = np.full((320, 240, 3), 90, np.uint8)
QUIET = replace(SensorUnit(), noise_bgr=(0.0, 0.0, 0.0), stripe_bgr=(0.0, 0.0, 0.0), dome_share=0.0)


def gel_mm(view: GelView, unit: SensorUnit = QUIET) -> NDArray[np.float32]:
    return GelCamera(unit, GRAY).draw_with_truth(view).displacement_mm


def center_mm(pressed: NDArray[np.generic]) -> tuple[float, float]:
    """Center of a field from the image center, right and up."""
    rows, columns = np.mgrid[0:320, 0:240]
    total = pressed.sum()
    right = float((pressed * (columns - 119.5)).sum() / total)
    return right / QUIET.px_per_mm, float(-(pressed * (rows - 159.5)).sum() / total) / QUIET.px_per_mm


@pytest.mark.parametrize("name", ["bar", "banana", "coin"])
def test_without_deviations_the_imprint_is_that_of_a_rigid_object(name: str) -> None:
    view = GelView(name, 0.7, -0.4, 25.0, 0.7)
    imprinter = Imprinter(SensorUnit(), GRAY)
    plain, neutral = imprinter.imprint(view, 0.008), imprinter.imprint(replace(view, effects=GelEffects()), 0.008)
    assert plain is not None
    assert neutral is not None
    assert plain.window == neutral.window
    assert np.abs(plain.change_bgr - neutral.change_bgr).max() < 1.5


def test_a_rolling_object_touches_on_the_side_that_comes_closer() -> None:
    view = GelView("banana", depth_mm=0.7)
    level = center_mm(gel_mm(view))
    for pitch_deg in (5.0, -5.0):
        moved = center_mm(gel_mm(replace(view, effects=GelEffects(pitch_deg=pitch_deg))))
        assert np.sign(moved[0] - level[0]) == np.sign(pitch_deg)
        assert abs(moved[0] - level[0]) > 1.0


def test_the_force_stays_the_same_when_the_object_is_tilted() -> None:
    view = GelView("egg", depth_mm=0.7)
    level = float(gel_mm(view).sum())
    for roll_deg in (3.0, 8.0):
        tilted = float(gel_mm(replace(view, effects=GelEffects(roll_deg=roll_deg))).sum())
        assert tilted == pytest.approx(level, rel=0.15)


def test_the_sticking_middle_follows_and_the_rim_lags() -> None:
    """A star of grooves: its phase shows the rotation at each radius."""
    raster = HeightRaster.of(lambda u, v: -grooves(np.arctan2(v, u), 2 * np.pi / 6, 0.4))
    effects = GelEffects(twist_deg=10.0, stick_mm=2.5)
    shown = GelCamera(QUIET, GRAY).draw_with_truth(GelView("", 0.0, 0.0, 0.0, 0.5, effects=effects), raster=raster)
    rows, columns = np.mgrid[0:320, 0:240]
    right, up = (columns - 119.5) / QUIET.px_per_mm, (159.5 - rows) / QUIET.px_per_mm
    radius, angle = np.hypot(right, up), np.arctan2(up, right)
    seen = []
    for r in (1.6, 5.8):
        ring = np.abs(radius - r) < 0.2
        phase = np.angle((shown.displacement_mm[ring] * np.exp(-6j * angle[ring])).sum())
        seen.append(-float(np.degrees(phase)) / 6.0)
    assert abs(seen[0]) < 1.0
    assert seen[1] == pytest.approx(-10.0, abs=1.0)


def test_shear_displaces_the_rim_only() -> None:
    for name, share in (("bead", 0.0), ("ring", 0.9)):
        view = GelView(name, depth_mm=0.6)
        sheared = GelEffects(shear_mm=(0.5, -0.3), stick_mm=0.5 if share else 3.0)
        moved = center_mm(gel_mm(replace(view, effects=sheared)) > 0.2)
        still = center_mm(gel_mm(view) > 0.2)
        expected = (-0.5 * share, 0.3 * share)
        assert (moved[0] - still[0], moved[1] - still[1]) == pytest.approx(expected, abs=0.08), name


def test_the_gel_remembers_and_forgets() -> None:
    camera = GelCamera(QUIET, GRAY, memory=GelMemory(0.3, 0.1))
    pressed, gone = GelView("bar", depth_mm=0.6), GelView("", depth_mm=-1.0)
    camera.draw(pressed)
    camera.settle()
    shown = [np.abs(camera.draw(gone).astype(float) - GRAY).mean() for _ in range(31)]
    whole = np.abs(GelCamera(QUIET, GRAY).draw(pressed).astype(float) - GRAY).mean()
    assert shown[0] == pytest.approx(0.3 * whole, rel=0.1)
    assert shown[6] == pytest.approx(np.exp(-1.0) * shown[0], rel=0.15)
    assert shown[30] < 0.05 * shown[0]


def test_a_lasting_memory_is_a_blend_with_the_settled_image() -> None:
    camera = GelCamera(QUIET, GRAY, memory=GelMemory(0.4, np.inf))
    first, second = GelView("key", angle_deg=0.0, depth_mm=0.7), GelView("key", angle_deg=30.0, depth_mm=0.7)
    camera.draw(first)
    camera.settle()
    plain = GelCamera(QUIET, GRAY)
    blend = 0.6 * plain.draw(second).astype(float) + 0.4 * plain.draw(first)
    assert np.abs(camera.draw(second) - blend).max() <= 2.0


def test_a_flat_face_on_a_long_dome_touches_in_a_long_ellipse() -> None:
    flat = HeightRaster.of(lambda u, v: np.zeros_like(u))
    unit = replace(QUIET, dome_radius_mm=30.0, dome_aspect=2.5, dome_share=1.0, skirt_mm=0.05)
    contact = GelCamera(unit, GRAY).draw_with_truth(GelView("", depth_mm=0.1), raster=flat).contact
    rows, columns = np.nonzero(contact)
    assert np.ptp(rows) / np.ptp(columns) == pytest.approx(2.5, rel=0.1)


@pytest.mark.parametrize(
    "effects", [GelEffects(pitch_deg=13.0), GelEffects(twist_deg=np.nan), GelEffects(stick_mm=0.0)]
)
def test_impossible_effects_are_rejected(effects: GelEffects) -> None:
    with pytest.raises(InputError):
        GelCamera(QUIET, GRAY).draw(GelView(find_object("bar").name, depth_mm=0.5, effects=effects))


@pytest.mark.parametrize("threaded", [False, True])
def test_a_ribbed_shaft_looks_the_same_after_a_pitch(threaded: bool) -> None:
    raster = Shaft(pitch_mm=1.5, groove_mm=0.4, threaded=threaded).raster()
    camera = GelCamera(QUIET, GRAY)
    at = [camera.draw(GelView("", x_mm=x_mm, depth_mm=0.6), raster=raster).astype(float) for x_mm in (0.0, 0.75, 1.5)]
    assert np.abs(at[1] - at[0]).mean() > 4.0 * np.abs(at[2] - at[0]).mean()


def test_a_shaft_ends_where_it_ends() -> None:
    raster = Shaft(end_mm=2.0).raster()
    contact = GelCamera(QUIET, GRAY).draw_with_truth(GelView("", x_mm=1.0, depth_mm=0.6), raster=raster).contact
    assert np.nonzero(contact.any(axis=0))[0].max() == pytest.approx(119.5 + 3.0 * QUIET.px_per_mm, abs=4.0)
    assert contact[:, 0].any()
