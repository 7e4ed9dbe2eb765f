"""An object that can be grasped: a height map for the gel, mass and friction for the mechanics."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

HeightMap = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[np.float32]]


@dataclass(frozen=True, slots=True)
class SimObject:
    """One graspable object.

    Attributes:
        split: "train" or "test".
        height_mm: object-frame coordinates (u right, v up, mm, float32 arrays) -> height of the surface towards the
            gel in mm, 0 at the highest point, negative elsewhere; floor at -1.5.
        com_offset_mm: distance of the center of mass from the grasp axis; it makes the object rotate when lifted.
        inertia_kg_m2: about the object's own center of mass.
        friction: between the surface and the gel.
        press_mm: indentation depth at 40 N per finger.
        width_mm: thickness between the fingers.
        axial: False if the contact patch has no readable axis (round).
    """

    name: str
    split: str
    height_mm: HeightMap
    mass_kg: float
    com_offset_mm: float
    inertia_kg_m2: float
    friction: float
    press_mm: float
    width_mm: float = 30.0
    axial: bool = True
