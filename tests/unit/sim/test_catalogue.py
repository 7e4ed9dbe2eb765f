"""The catalogue: properties of every object, and that the test set is the published one."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from slipguard.errors import InputError
from slipguard.sim import catalogue_test, shapes
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import height_raster_of
from slipguard.sim.sensor_unit import SensorUnit

ALL = (*object_names("train"), *object_names("test"))
MANIFEST_SHA256 = "acc58316d8430c44bdc77d9aa98b8215ca0a0446b27bc65f47cbf16304260958"
"""Digest of the published set; figures on other sets are not comparable."""
AXIS = np.arange(-18.0, 18.0, 0.05, dtype=np.float32)


def manifest_sha256() -> str:
    """Return the digest of names, shapes and mechanics. Shapes: 0.01 mm steps on a fixed 1 mm grid."""
    axis = np.arange(-12, 13, dtype=np.float32)
    u, v = np.meshgrid(axis, -axis)
    digest = hashlib.sha256()
    for item in catalogue_test.OBJECTS:
        heights = np.rint(np.maximum(item.height_mm(u, v), -1.5) * 100).astype("<i2")
        mechanics = (item.mass_kg, item.com_offset_mm, item.inertia_kg_m2, item.friction, item.press_mm, item.width_mm)
        digest.update(f"{item.name} {item.split} {item.axial} {mechanics!r}\n".encode())
        digest.update(heights.tobytes())
    return digest.hexdigest()


def test_there_are_enough_and_no_name_twice() -> None:
    assert len(object_names("train")) >= 18
    assert len(object_names("test")) == 10
    assert len(set(ALL)) == len(ALL)


def test_the_test_set_is_the_published_one() -> None:
    assert manifest_sha256() == MANIFEST_SHA256


@pytest.mark.parametrize("name", ALL)
def test_heights_are_float32_with_their_top_at_zero(name: str) -> None:
    heights = find_object(name).height_mm(*np.meshgrid(AXIS, -AXIS))
    assert heights.dtype == np.float32
    assert np.isfinite(heights).all()
    assert float(heights.max()) == pytest.approx(0.0, abs=0.015)


@pytest.mark.parametrize("name", ALL)
def test_mechanics_need_a_strong_grip(name: str) -> None:
    item = find_object(name)
    assert 48.0 <= needed_force_n(item, SoftPad()) <= 75.0
    assert 0.4 <= item.friction <= 1.0
    assert 0.05 <= item.mass_kg <= 1.5
    assert item.inertia_kg_m2 > 0.0
    assert 0.4 <= item.press_mm <= 1.5
    assert item.width_mm < 85.0


def test_one_is_heavy_and_one_strongly_curved() -> None:
    heavy, curved = find_object("bar"), find_object("ball")
    assert heavy.mass_kg > 1.2
    assert heavy.com_offset_mm < 60.0
    camera = GelCamera(SensorUnit())
    image = camera.draw(GelView("ball", x_mm=-1.5, depth_mm=curved.press_mm)).astype(float)
    off = np.abs(image - camera.no_contact())
    assert off.max() > 90  # the signal range of a real DIGIT is about 100 gray levels


def test_the_forces_needed_by_the_test_set_are_spread() -> None:
    forces = sorted(needed_force_n(find_object(name), SoftPad()) for name in object_names("test"))
    assert forces[0] < 52
    assert forces[-1] > 70
    assert max(np.diff(forces)) < 8


@pytest.mark.parametrize("name", ["bar", "wedge", "wrench", "knife_edge", "key", "screwdriver", "hook"])
def test_axial_objects_have_a_long_patch(name: str) -> None:
    item = find_object(name)
    truth = GelCamera(SensorUnit()).draw_with_truth(GelView(name, depth_mm=item.press_mm))
    rows, columns = np.nonzero(truth.contact)
    spread = np.linalg.eigvalsh(np.cov(rows, columns))
    assert item.axial
    assert spread[1] > 1.3 * spread[0]


@pytest.mark.parametrize("name", ["cap", "ring", "ball"])
def test_round_objects_say_so(name: str) -> None:
    assert not find_object(name).axial


def test_the_handle_is_clipped_by_the_frame() -> None:
    item = find_object("screwdriver")
    contact = GelCamera(SensorUnit()).draw_with_truth(GelView(item.name, depth_mm=item.press_mm)).contact
    assert contact[:, 0].any()


def test_no_test_shape_is_among_the_training_shapes() -> None:
    """Best match over rotations, of the surface to a common depth: well below that of a shape with itself."""
    train = {name: height_raster_of(name).coarse for name in object_names("train")}
    for name in object_names("test"):
        mine = np.maximum(height_raster_of(name).coarse, -0.8)
        for other, theirs in train.items():
            for quarter in range(4):
                match = np.corrcoef(mine.ravel(), np.rot90(np.maximum(theirs, -0.8), quarter).ravel())[0, 1]
                assert match < 0.97, (name, other)


def test_unknown_names_and_splits_are_rejected_with_the_alternatives() -> None:
    with pytest.raises(InputError, match="screwdriver"):
        find_object("spanner")
    with pytest.raises(InputError, match="train, test"):
        object_names("validation")


def test_contours_are_signed_distances() -> None:
    u, v = (f.astype(np.float32) for f in np.meshgrid(np.linspace(-3, 3, 61), np.linspace(-3, 3, 61)))
    box = shapes.box(u, v, 2.0, 1.0)
    assert box[30, 30] == pytest.approx(-1.0)
    assert box[30, 60] == pytest.approx(1.0, abs=1e-5)
    square = shapes.polygon(u, v, [(-1, -1), (1, -1), (1, 1), (-1, 1)])
    assert np.allclose(square, shapes.box(u, v, 1.0, 1.0), atol=1e-5)
    assert np.allclose(shapes.without(shapes.disc(u, v, 2.0), shapes.disc(u, v, 1.0))[30, 30], 1.0)


def test_rotated_coordinates_are_counter_clockwise() -> None:
    u, v = shapes.rotated(np.float32([0.0]), np.float32([1.0]), 90.0)
    assert (float(u[0]), float(v[0])) == pytest.approx((1.0, 0.0), abs=1e-6)
