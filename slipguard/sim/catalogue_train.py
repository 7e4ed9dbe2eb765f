"""The training objects: other shapes than the test objects. Lengths in mm.

They include plain balls, because balls are used to calibrate sensors; the test ball is dimpled.
"""

from __future__ import annotations

import math

import numpy as np

from slipguard.sim import shapes as s
from slipguard.sim.raster import Field, f32
from slipguard.sim.sim_object import SimObject


def _egg(u: Field, v: Field) -> Field:
    return np.float32(-1.4) * ((u / np.float32(5.0)) ** 2 + (v / np.float32(2.4)) ** 2)


def _cross(u: Field, v: Field) -> Field:
    return s.plateau(s.union(s.box(u, v, 5.2, 1.0), s.box(u, v, 1.0, 3.6)), 0.35)


def _bracket(u: Field, v: Field) -> Field:
    return s.plateau(s.union(s.box(u, v, 5.0, 1.0, (0.6, -2.2)), s.box(u, v, 1.0, 3.4, (-3.4, 0.2))), 0.4)


def _tee(u: Field, v: Field) -> Field:
    return s.plateau(s.union(s.box(u, v, 1.1, 3.4, (-3.6, 0.0)), s.box(u, v, 4.6, 1.1, (1.0, 0.0))), 0.4)


def _triangle(u: Field, v: Field) -> Field:
    return s.plateau(s.polygon(u, v, [(-4.2, -2.8), (5.4, -2.2), (-2.2, 3.6)]), 0.4)


def _nut(u: Field, v: Field) -> Field:
    return s.plateau(s.without(s.regular(u, v, 6, 4.6), s.disc(u, v, 2.3)), 0.35)


def _star(u: Field, v: Field) -> Field:
    tips, notches = s.arc(5.2, 90, 378, count=5), s.arc(2.3, 126, 414, count=5)
    contour = [point for pair in zip(tips, notches, strict=True) for point in pair]
    return s.plateau(s.polygon(u, v, contour), 0.3)


def _gear(u: Field, v: Field) -> Field:
    teeth = np.float32(0.55) * np.tanh(np.float32(3.0) * np.cos(np.arctan2(v, u) * 14))
    return s.plateau(s.without(np.hypot(u, v) - np.float32(4.6) - teeth, s.disc(u, v, 1.4)), 0.25)


def _coin(u: Field, v: Field) -> Field:
    lettering = s.union(s.box(u, v, 0.45, 2.0, (-1.2, 0.0)), s.path(u, v, s.arc(1.3, 110, -110, (0.4, 0.0)), 0.35))
    sunk = s.inside(s.disc(u, v, 4.0), 0.25) * (1 - s.inside(lettering - np.float32(0.15), 0.25))
    milling = s.rays(u, v, 60, 0.2, 4.8) * s.inside(-s.disc(u, v, 4.7), 0.1)
    return f32(s.plateau(s.disc(u, v, 5.1), 0.3) - np.float32(0.22) * sunk - milling)


def _rod(u: Field, v: Field) -> Field:
    return s.cylinder(v, 3.0)


def _cone(u: Field, v: Field) -> Field:
    return f32(np.float32(0.15) - np.sqrt(np.float32(0.0225) + np.float32(0.36) * (u * u + v * v)))


def _pins(u: Field, v: Field) -> Field:
    return s.highest(s.sphere(u, v, 1.4, (-2.9, 0.0)), s.sphere(u, v, 1.4, (2.9, 0.0)))


def _comb(u: Field, v: Field) -> Field:
    teeth = [s.path(u, v, [(x, -0.5), (x, 2.9)], 0.38) for x in np.arange(-5.0, 5.1, 1.6).tolist()]
    return s.plateau(s.union(s.box(u, v, 5.6, 0.8, (0.0, -1.6)), *teeth), 0.3)


def _spring(u: Field, v: Field) -> Field:
    strand = np.abs((u - np.float32(0.22) * v) % np.float32(1.7) - np.float32(0.85))
    return s.cylinder(v, 4.5) + s.cylinder(strand, 0.62)


def _slotted(u: Field, v: Field) -> Field:
    slots = [s.box(u, v, 0.45, 2.2, (x, 0.0), corner=0.4) for x in (-3.0, 0.0, 3.0)]
    return s.plateau(s.without(s.box(u, v, 5.2, 3.6, corner=1.2), *slots), 0.4)


def _pen(u: Field, v: Field) -> Field:
    taper = np.float32(0.16) * np.maximum(-u - 2, 0)
    clip = s.plateau(s.box(u, v, 4.5, 0.5, (6.0, 0.0), corner=0.3), 0.3)
    return s.highest(s.cylinder(v, 4.0) - taper - np.float32(0.3), clip)


def _banana(u: Field, v: Field) -> Field:
    across = v - np.float32(0.055) * u * u
    return f32(s.cylinder(across, 5.5) - np.float32(0.012) * u * u - np.maximum(np.abs(u) - 7, 0))


def _hammer(u: Field, v: Field) -> Field:
    oval = np.float32(-1.0) * (np.abs(v) / np.float32(5.6)) ** 2.6
    return f32(oval - s.grooves(u - np.float32(0.3), 4.4, 0.12))


def _battery(u: Field, v: Field) -> Field:
    can = s.lowered(s.cylinder(v, 7.0), s.box(u, v, 6.0, 20.0, (-2.0, 0.0)))
    pole = s.lowered(s.cylinder(v, 2.6) - np.float32(0.35), s.box(u, v, 1.0, 2.3, (4.8, 0.0)))
    return s.highest(can, pole)


def _dovetail(u: Field, v: Field) -> Field:
    return s.plateau(s.polygon(u, v, [(-5, -1.2), (-5, 1.2), (0.5, 1.2), (4.6, 3.4), (4.6, -3.4), (0.5, -1.2)]), 0.35)


def _arrow(u: Field, v: Field) -> Field:
    contour = [(-6, -0.7), (-6, 0.7), (0.6, 0.7), (0.6, 2.9), (5.8, 0), (0.6, -2.9), (0.6, -0.7)]
    return s.plateau(s.polygon(u, v, contour), 0.35)


def _bead(u: Field, v: Field) -> Field:
    return s.sphere(u, v, 2.4)


def _marble(u: Field, v: Field) -> Field:
    return s.sphere(u, v, 4.4)


def _sector(u: Field, v: Field) -> Field:
    rim = s.polygon(u, v, [(-4.0, -4.0), (3.8, -4.0), *s.arc(7.8, 0.0, 90.0, (-4.0, -4.0), count=15)])
    return s.plateau(rim, 0.2) - np.float32(0.06) * s.inside(rim, 1.2)


def _crescent(u: Field, v: Field) -> Field:
    return s.plateau(s.without(s.disc(u, v, 4.8), s.disc(u, v, 4.2, (2.2, 0.4))), 0.4)


def _zigzag(u: Field, v: Field) -> Field:
    line = [(-6.0, -1.3), (-3.0, 1.5), (0.0, -1.3), (3.0, 1.5), (6.0, -1.3)]
    return s.cylinder(s.path(u, v, line, 0.0), 0.95)


def _bolt(u: Field, v: Field) -> Field:
    thread = s.cylinder(v, 3.2) - np.float32(0.5) * np.abs(((u - np.float32(0.12) * v) / 1.25) % 1 - 0.5) * 2
    head = s.plateau(s.box(u, v, 1.6, 4.0, (-5.0, 0.0)), 0.3)
    return s.highest(head, s.lowered(thread, s.box(u, v, 8.0, 8.0, (4.0, 0.0))))


def _bottle(u: Field, v: Field) -> Field:
    shoulder = np.float32(0.35) * (1 + np.tanh((u - 3) * np.float32(0.8))) / 2
    return f32(s.cylinder(v, 14.0) - shoulder - np.float32(0.004) * u * u * (u < 3))


def _clover(u: Field, v: Field) -> Field:
    lobes = [s.disc(u, v, 2.1, (2.4 * math.cos(a), 2.4 * math.sin(a))) for a in (0.4, 2.5, 4.6)]
    return s.plateau(s.union(*lobes), 0.5)


OBJECTS = (
    SimObject("egg", "train", _egg, 1.1, 40.0, 0.00081, 0.6, 1.0, 40.0),
    SimObject("cross", "train", _cross, 1.1, 60.0, 0.0017, 0.7, 0.8, 25.0),
    SimObject("bracket", "train", _bracket, 0.79, 102.0, 0.0034, 0.7, 0.8, 22.0),
    SimObject("tee", "train", _tee, 0.55, 74.0, 0.0013, 0.5, 0.8, 24.0),
    SimObject("triangle", "train", _triangle, 0.31, 264.0, 0.0088, 0.8, 0.8, 30.0),
    SimObject("nut", "train", _nut, 0.65, 114.0, 0.0035, 0.6, 0.8, 28.0, axial=False),
    SimObject("star", "train", _star, 0.68, 92.0, 0.0024, 0.7, 0.8, 20.0, axial=False),
    SimObject("gear", "train", _gear, 0.3, 183.0, 0.0042, 0.5, 0.7, 26.0, axial=False),
    SimObject("coin", "train", _coin, 0.3, 154.0, 0.003, 0.6, 0.6, 12.0, axial=False),
    SimObject("rod", "train", _rod, 1.3, 29.0, 0.00054, 0.4, 1.0, 16.0),
    SimObject("cone", "train", _cone, 0.93, 88.0, 0.003, 0.7, 1.3, 30.0, axial=False),
    SimObject("pins", "train", _pins, 0.5, 101.0, 0.0022, 0.6, 1.0, 20.0),
    SimObject("comb", "train", _comb, 0.71, 73.0, 0.0016, 0.5, 0.7, 18.0),
    SimObject("spring", "train", _spring, 1.27, 44.0, 0.0011, 0.45, 1.0, 24.0),
    SimObject("slotted_plate", "train", _slotted, 1.19, 61.0, 0.0019, 0.8, 0.7, 20.0),
    SimObject("pen", "train", _pen, 1.14, 58.0, 0.0016, 0.6, 1.0, 18.0),
    SimObject("banana", "train", _banana, 0.66, 107.0, 0.0031, 0.9, 1.1, 36.0),
    SimObject("hammer", "train", _hammer, 0.77, 102.0, 0.0033, 0.8, 0.8, 32.0),
    SimObject("battery", "train", _battery, 0.96, 74.0, 0.0022, 0.6, 0.9, 26.0),
    SimObject("dovetail", "train", _dovetail, 0.31, 194.0, 0.0048, 0.7, 0.8, 24.0),
    SimObject("arrow", "train", _arrow, 0.83, 70.0, 0.0017, 0.55, 0.8, 20.0),
    SimObject("bead", "train", _bead, 0.54, 141.0, 0.0044, 0.6, 1.2, 20.0, axial=False),
    SimObject("marble", "train", _marble, 1.17, 47.0, 0.0011, 0.6, 1.4, 24.0, axial=False),
    SimObject("sector", "train", _sector, 0.32, 249.0, 0.0081, 0.7, 0.7, 24.0),
    SimObject("crescent", "train", _crescent, 0.96, 54.0, 0.0012, 0.65, 0.8, 22.0),
    SimObject("zigzag", "train", _zigzag, 1.16, 51.0, 0.0013, 0.6, 0.8, 20.0),
    SimObject("bolt", "train", _bolt, 0.49, 124.0, 0.0031, 0.5, 0.9, 22.0),
    SimObject("bottle", "train", _bottle, 1.19, 58.0, 0.0017, 0.8, 0.9, 60.0),
    SimObject("clover", "train", _clover, 1.17, 64.0, 0.002, 0.7, 0.8, 26.0, axial=False),
)
