"""What can be grasped: outline and texture for the gel, mass and friction for the mechanics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError

HeightMap = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class SimObject:
    """One graspable thing.

    height_mm: object-frame coordinates (u right, v up, mm, float32 arrays) -> height of the surface towards the gel
        in mm, 0 at the highest point, negative elsewhere; floor at -1.5.
    com_offset_mm: distance of the centre of mass from the grasp axis; what makes it turn when lifted.
    inertia_kg_m2: about its own centre of mass.
    friction: between its surface and the gel.
    press_mm: indentation depth at 40 N per finger.
    """

    name: str
    split: str  # "train" or "test"
    height_mm: HeightMap
    mass_kg: float
    com_offset_mm: float
    inertia_kg_m2: float
    friction: float
    press_mm: float
    width_mm: float = 30.0  # thickness between the fingers
    axial: bool = True  # False: its patch has no readable axis (round)


def get(name: str) -> SimObject:
    """The catalogue object of that name; raises InputError that lists the names."""
    found = _catalogue().get(name)
    if found is None:
        raise InputError(f"no object {name!r}; there are: {', '.join(sorted(_catalogue()))}")
    return found


def names(split: str) -> tuple[str, ...]:
    """Names of the "train" or the "test" objects, in a fixed order. Raises InputError for another split."""
    if split not in ("train", "test"):
        raise InputError(f"no split {split!r}; there are: train, test")
    return tuple(item.name for item in _catalogue().values() if item.split == split)


@cache
def _catalogue() -> dict[str, SimObject]:
    # Here and not above: they are made of this module's SimObject.
    from slipguard.sim.catalogue_test import OBJECTS as FOR_TESTING
    from slipguard.sim.catalogue_train import OBJECTS as FOR_TRAINING

    return {item.name: item for item in (*FOR_TRAINING, *FOR_TESTING)}
