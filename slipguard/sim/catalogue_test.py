"""The ten test objects: shapes that are not used in training. Their manifest is fixed.

Two are difficult on purpose: `bar` is heavy, `ball` is so curved that it saturates the image. Lengths in mm. Masses and
levers are chosen so that each needs 48-75 N per finger.
"""

from __future__ import annotations

import numpy as np

from slipguard.sim import shapes as s
from slipguard.sim.raster import Field, f32
from slipguard.sim.sim_object import SimObject


def _bar(u: Field, v: Field) -> Field:
    return s.plateau(s.box(u, v, 5.5, 1.7, corner=0.3), 0.45)


def _wedge(u: Field, v: Field) -> Field:
    face = np.float32(-0.085) * (u + 6)
    return s.lowered(np.minimum(face, 0) - s.grooves(v, 40.0, 0.1), s.box(u, v, 6.0, 2.6, corner=0.4))


def _wrench(u: Field, v: Field) -> Field:
    head = s.disc(u, v, 4.6, (-3.4, 0.0))
    jaw = s.box(*s.rotated(u, v, 15.0, (-6.6, -0.85)), 4.0, 1.9)
    shaft = s.box(u, v, 16.0, 1.9, (14.5, 0.0))
    panel = s.box(u, v, 14.0, 0.95, (15.5, 0.0), corner=0.9)
    return s.plateau(s.union(s.without(head, jaw), shaft), 0.5) - np.float32(0.35) * s.inside(panel, 0.3)


def _knife(u: Field, v: Field) -> Field:
    bowed = v - np.float32(0.012) * u * u
    return s.ridge(bowed, 0.9, 0.15) - np.float32(0.004) * u * u - np.float32(0.6) * np.maximum(np.abs(u) - 6.5, 0)


def _key(u: Field, v: Field) -> Field:
    bow = s.without(s.disc(u, v, 3.6, (-5.2, 0.0)), s.disc(u, v, 1.2, (-6.4, 0.0)))
    blade = [(-3, -1.2), (7.6, -1.2), (8.4, -0.2), (7.6, 0.9), (6.6, 0.2), (5.6, 1.3), (4.4, 0.5), (3.4, 1.4)]
    blade += [(2.2, 0.3), (1.2, 1.3), (-0.2, 1.5), (-3, 1.5)]
    contour = s.union(bow, s.polygon(u, v, blade))
    return s.plateau(contour, 0.25) - np.float32(0.25) * s.inside(s.box(u, v, 5.6, 0.22, (2.4, -0.5)), 0.15)


def _screwdriver(u: Field, v: Field) -> Field:
    around = np.arcsin(np.clip(v / 8.5, -1, 1)).astype(np.float32)
    flutes = s.grooves(around, 2 * np.pi / 14, 0.45) * np.clip((np.float32(10.0) - u) * np.float32(0.3), 0, 1)
    waist = np.float32(0.012) * np.maximum(u - 1, 0) ** 2
    return f32(s.cylinder(v, 8.5) - flutes - np.minimum(waist, 0.6))


def _cap(u: Field, v: Field) -> Field:
    crown = s.plateau(s.disc(u, v, 4.6), 0.7)
    return crown - s.rays(u, v, 26, 0.5, 2.9) - s.knurl(u, v, 1.15, 0.16) * s.inside(s.disc(u, v, 2.7), 0.2)


def _ring(u: Field, v: Field) -> Field:
    return s.cylinder(np.hypot(u, v) - np.float32(3.7), 1.15)


def _ball(u: Field, v: Field) -> Field:
    return s.sphere(u, v, 5.2) - s.dimples(u, v, period=2.3, radius=0.95, depth=0.4)


def _hook(u: Field, v: Field) -> Field:
    spine = [(8.0, 2.6), (0.0, 2.6), *s.arc(2.6, 90.0, 290.0, count=11)]
    across = s.path(u, v, spine, 0.0)
    return s.cylinder(across, 1.25)


OBJECTS = (
    SimObject("bar", "test", _bar, 1.35, 55.0, 0.0017, 0.6, 0.9, 28.0),
    SimObject("wedge", "test", _wedge, 0.55, 88.0, 0.0018, 0.6, 1.0, 34.0),
    SimObject("wrench", "test", _wrench, 0.6, 127.0, 0.004, 0.7, 0.8, 18.0),
    SimObject("knife_edge", "test", _knife, 0.4, 111.0, 0.0021, 0.5, 1.0, 22.0),
    SimObject("key", "test", _key, 0.3, 100.0, 0.0013, 0.4, 0.8, 14.0),
    SimObject("screwdriver", "test", _screwdriver, 0.5, 165.0, 0.0056, 0.85, 1.0, 32.0),
    SimObject("cap", "test", _cap, 0.7, 91.0, 0.0024, 0.75, 0.8, 40.0, axial=False),
    SimObject("ring", "test", _ring, 0.45, 126.0, 0.003, 0.55, 0.9, 26.0, axial=False),
    SimObject("ball", "test", _ball, 0.8, 147.0, 0.0071, 1.0, 1.45, 44.0, axial=False),
    SimObject("hook", "test", _hook, 0.5, 120.0, 0.003, 0.65, 0.9, 20.0),
)
