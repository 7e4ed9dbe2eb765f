"""The catalogue: properties of every object, and that the test set is the published one."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from slipguard.errors import InputError
from slipguard.sim import catalogue_test
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.height_raster import height_raster_of

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
