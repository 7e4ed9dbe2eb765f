"""The load of a grip over what it can hold: one state with its uncertainty, elastic below 1, slip at 1.

A finger that presses with N on a soft patch holds a torque of T(N) ~ N^(1 + gamma) and a shear force of mu N
(limit_surface.py). Below that the gel twists and shifts in proportion to the load, by at most

    u(N) = T(N) / k(N) ~ N^(1 - 2 gamma)        with the torsional stiffness k = 16/3 G a^3 (Johnson, 3.10)

for shear counts as torsion here, at 2 xi nu / a radians per meter: the limit surface is an ellipse, and the stiffness
of a half-space in shear is k / a^2 (Johnson, 3.7). So lambda, the load over the capacity, is a vector that grows with
each motion by du / u(N), and is never longer than 1: what would exceed 1 is slip. A firmer grip divides it by
(N' / N)^(1 + gamma).

The elastic limit u depends on the gel and on the friction, and is not known: it may be a tenth of a degree on a stiff
pad and 15 degrees on a soft one. While the far end of an object still rests on the table, no image separates slip from
elastic motion. So there is one lambda for each limit of a grid, with a weight. Three things change the weights:

- Stiffness and friction differ between gels, contacts and objects (`started`).
- A load far above what the first grip holds is improbable, for a person chose that grip (`LOAD_PRIOR`).
- An object that no longer moves although the arm rises hangs, and is held. A limit at which it would have slipped is
  refuted, and one of which an unanswered load used its usual share is likely (`hung`).

Sources: K. L. Johnson: Contact Mechanics (1985). R. D. Howe, M. R. Cutkosky: Practical force-motion models for sliding
manipulation (1996). N. Xydas, I. Kao: Modeling of contact mechanics and friction limit surfaces for soft fingers
(1999).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import accumulate

from slipguard.control.contact_motion import ZERO, ContactMotion, Vector
from slipguard.limit_surface import Pad, pressure_shape, torque_limit_n_m

PAD = Pad()
CAPACITY_EXPONENT = 1.0 + PAD.gamma
AT_N = 40.0
"""Force at which elastic limits are stated."""
LIMITS_DEG = tuple(0.1 * 1.5**k for k in range(15))
"""Elastic limits of the grid, 0.1 to 29 degrees at `AT_N`."""
STIFFNESS_RADIUS_M = 6e-3
"""Contact radius at which the stiffness of a gel is stated."""
FRICTION, FRICTION_SPREAD = 0.5, 0.35
"""Of objects on the gel: median, and standard deviation of the logarithm. No figure for DIGITs is published."""
SHARE, SHARE_SPREAD = 0.3, 0.45
"""Load over capacity of an object that the first grip holds: median, and spread of the logarithm."""
LOAD_PRIOR = 0.8
"""The load over what the first grip holds is log-normal with the median 1 and this spread."""
REFUTED = 0.02
"""Remaining weight of an elastic limit at which the object would have slipped on."""
HANGS_MM, HANGS_DEG = 5.0, 0.5
"""An object that moves by less than this while the arm rises this far hangs. The far end of one that is still on the
table rotates it by 0.5 degrees even if it is 570 mm away."""


@dataclass(frozen=True, slots=True)
class LogNormal:
    """An estimated quantity: its median, and the standard deviation of its logarithm."""

    median: float
    spread: float


STIFFNESS_PRIOR = LogNormal(0.4, 0.8)
"""Torsional stiffness of one unknown gel at 6 mm, N m/rad. 0.16 follows from 0.14 MPa, 50 is a stiff pad."""


def elastic_limit_deg(force_n: float) -> float:
    """Return the elastic limit at this force relative to that at `AT_N`."""
    return math.pow(max(force_n, 1.0) / AT_N, 1.0 - 2.0 * PAD.gamma)


def deg_per_mm(force_n: float) -> float:
    """Return the torsion that uses as much of the capacity as a shear of 1 mm."""
    return math.degrees(2.0 * pressure_shape(PAD.pressure_k) / PAD.contact_radius_m(max(force_n, 1.0))) * 1e-3


def as_limit(stiffness: LogNormal) -> LogNormal:
    """Return the elastic limit at `AT_N` in degrees of gels with this stiffness."""
    gel = (PAD.contact_radius_m(AT_N) / STIFFNESS_RADIUS_M) ** 3
    return LogNormal(math.degrees(torque_limit_n_m(AT_N, FRICTION, PAD) / gel) / stiffness.median, stiffness.spread)


@dataclass(frozen=True, slots=True)
class LoadState:
    """What is known of the load of the held object. Tuples have one entry for each limit of `LIMITS_DEG`.

    Args:
        motion: of the contact.
        weights: probability of each limit; empty before the first estimate.
        loads: load over capacity at `force_n`. slipped: whether it has reached 1 at this force.
        peaks: largest load so far, over the capacity of the first grip `first_n`.
        jaws_moved_s, object_moved_s: when the jaws and the object last moved.
        at_limit: position at which the gripper first held with the force limit; None: it does not.
        far_frames: frames in a row in which the object has rotated too far.
        lowest_mm: lowest height of the arm since the grip. level_mm, level: height and position from which the arm has
            risen without moving the object, since the force last changed.
        hangs: the whole load has arrived.
        tightened: the grip was tightened for this load.
    """

    motion: ContactMotion = field(default_factory=ContactMotion)
    weights: tuple[float, ...] = ()
    loads: tuple[Vector, ...] = ()
    slipped: tuple[bool, ...] = ()
    peaks: tuple[float, ...] = ()
    force_n: float = 0.0
    first_n: float = 0.0
    jaws_moved_s: float = -math.inf
    object_moved_s: float = -math.inf
    at_limit: Vector | None = None
    far_frames: int = 0
    lowest_mm: float | None = None
    level_mm: float = math.inf
    level: Vector = ZERO
    hangs: bool = False
    tightened: bool = False

    def started(self, gel: LogNormal, force_n: float) -> LoadState:
        """Return the state of an object that has just been gripped with this force."""
        limit = as_limit(gel)
        spread = math.hypot(limit.spread, FRICTION_SPREAD)
        weights = [math.exp(-0.5 * (math.log(deg / limit.median) / spread) ** 2) for deg in LIMITS_DEG]
        none, force_n = len(LIMITS_DEG), max(force_n, 1.0)
        return replace(
            self, weights=_normalized(weights), loads=(ZERO,) * none, slipped=(False,) * none, peaks=(0.0,) * none,
            force_n=force_n, first_n=force_n,
        )  # fmt: skip

    def gripped(self, force_n: float) -> LoadState:
        """Return the state after the grip has become firmer: the same load is less of the capacity."""
        if force_n <= self.force_n:
            return self
        share = (self.force_n / force_n) ** CAPACITY_EXPONENT
        loads = tuple((share * deg, share * down, share * side) for deg, down, side in self.loads)
        return replace(self, loads=loads, slipped=(False,) * len(loads), force_n=force_n)

    def moved(self, motion: Vector, *, put_down: bool) -> LoadState:
        """Return the state after a motion of the object. put_down: one back to the reference only unloads the grip."""
        unloads = put_down and sum(m * p for m, p in zip(motion, self.motion.position, strict=True)) < 0.0
        loads, slipped, peaks = [], [], []
        first = (self.force_n / self.first_n) ** CAPACITY_EXPONENT
        for load, step, peak in zip(self.loads, self._steps(motion), self.peaks, strict=True):
            size, change = math.hypot(*load), math.hypot(*step)
            if unloads:
                kept = max(size - change, 0.0) / size if size > 0.0 else 0.0
                load = (kept * load[0], kept * load[1], kept * load[2])
            else:
                load = (load[0] + step[0], load[1] + step[1], load[2] + step[2])
            size = math.hypot(*load)
            over = max(size, 1.0)
            loads.append((load[0] / over, load[1] / over, load[2] / over))
            slipped.append(size > 1.0)
            peaks.append(max(peak, min(size, 1.0) * first))
        before = zip(slipped, self.slipped, strict=True)
        return replace(self, loads=tuple(loads), slipped=tuple(a or b for a, b in before), peaks=tuple(peaks))

    def risen(self, height_mm: float) -> LoadState:
        """Return the state with the arm at this height: the object hangs once the arm rises without moving it."""
        lowest_mm = height_mm if self.lowest_mm is None else min(self.lowest_mm, height_mm)
        deg, down_mm, side_mm = (a - b for a, b in zip(self.motion.position, self.level, strict=True))
        per_mm = deg_per_mm(self.force_n)
        moved_deg = math.hypot(deg, per_mm * down_mm, per_mm * side_mm)
        now = replace(self, lowest_mm=lowest_mm)
        if moved_deg > max(HANGS_DEG, self.motion.band[0]) or height_mm < self.level_mm:
            return replace(now, level_mm=height_mm, level=self.motion.position)
        return now._hung() if height_mm - self.level_mm >= HANGS_MM and not self.hangs else now

    def set_down(self) -> LoadState:
        """Return the state of an object that is being put down: its load leaves, and arrives again in the next lift."""
        return replace(self, hangs=False, level_mm=math.inf)

    def over_capacity(self, quantile: float, soon: Vector = ZERO, most: float = math.inf) -> float:
        """Return the load over the capacity of the present grip that is not exceeded with this probability.

        Args:
            soon: further motion to expect. most: what a load can grow to until the grip has been tightened.
        """
        loads = [
            max(min(math.hypot(*(a + b for a, b in zip(load, step, strict=True))), most), math.hypot(*load))
            for load, step in zip(self.loads, self._steps(soon), strict=True)
        ]
        return _quantile(loads, self._probable(), quantile)

    def elastic_limit_deg(self, quantile: float) -> float:
        """Return the elastic torsion of the present grip that is not exceeded with this probability."""
        return _quantile(LIMITS_DEG, self._probable(), quantile) * elastic_limit_deg(self.force_n)

    def _steps(self, motion: Vector) -> list[Vector]:
        """Return a motion as a share of each elastic limit at the present force."""
        per_mm, here = deg_per_mm(self.force_n), elastic_limit_deg(self.force_n)
        deg, down, side = motion[0], per_mm * motion[1], per_mm * motion[2]
        return [(deg / (limit * here), down / (limit * here), side / (limit * here)) for limit in LIMITS_DEG]

    def _probable(self) -> tuple[float, ...]:
        """Return the weights, with what the first grip says about the load until the load is known to be held."""
        if self.hangs:
            return self.weights
        pairs = zip(self.weights, self.peaks, strict=True)
        return _normalized([weight * _exceeds(peak) for weight, peak in pairs])

    def _hung(self) -> LoadState:
        """Return the state of an object that hangs: what would have slipped on is refuted."""
        band_deg, here, weights = self.motion.band[0], elastic_limit_deg(self.force_n), []
        for weight, load, slipped, limit in zip(self._probable(), self.loads, self.slipped, LIMITS_DEG, strict=True):
            if slipped:
                weight *= REFUTED
            if not self.tightened:
                share = math.hypot(*load, band_deg / (limit * here))
                weight *= math.exp(-0.5 * (math.log(share / SHARE) / SHARE_SPREAD) ** 2)
            weights.append(weight)
        return replace(self, hangs=True, weights=_normalized(weights))


def _exceeds(load: float) -> float:
    """Return the probability that a load exceeds this multiple of what the first grip holds."""
    return 0.5 * math.erfc(math.log(load) / (LOAD_PRIOR * math.sqrt(2.0))) if load > 0.0 else 1.0


def _normalized(weights: Sequence[float]) -> tuple[float, ...]:
    total = sum(weights)
    return tuple(weight / total for weight in weights)


def _quantile(values: Sequence[float], weights: Sequence[float], quantile: float) -> float:
    """Return the smallest value up to which the weights sum to this share."""
    ordered = sorted(zip(values, weights, strict=True))
    reached = accumulate(weight for _, weight in ordered)
    found = (value for (value, _), sum_so_far in zip(ordered, reached, strict=True) if sum_so_far >= quantile)
    return next(found, ordered[-1][0])
