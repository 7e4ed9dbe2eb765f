"""How a held object moves in the grip: what exceeds the noise of the estimates, and where it leads.

All motion is relative to the reference: degrees of rotation, and mm down and to the right in the left image. A motion
counts from the first frame that exceeds the noise, except that a leap of a single frame, such as a flash of light
causes, waits for a second frame while the object should be at rest.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace

from slipguard.control.finger_fusion import FusedEstimate

Vector = tuple[float, float, float]
ZERO: Vector = (0.0, 0.0, 0.0)

NOISE_LEAST: Vector = (0.02, 0.007, 0.007)
"""Noise from frame to frame of a textured contact, degrees and mm: of the median of eight test objects."""
NOISE_START: Vector = (0.1, 0.03, 0.03)
"""Noise before it is learned: of a faint or smooth contact."""
NOISE_SIGMAS = 3.0
"""A motion beyond this many standard deviations of the noise is no noise."""
WIDENS_MOST = 3.0
"""A sigma wider than usual widens the noise by no more than this: fingers that disagree must not hide slip."""
NOISE_FRAMES = 20.0
"""The noise is learned at rest over this many frames, a third of a second."""
RATE_S = 0.05
"""Time constant of the rate: three frames at 60 fps."""
LEAP: Vector = (1.0, 0.1, 0.1)
"""A single wrong frame errs by no more than this; what exceeds it counts at once."""
APART_S = 0.02
"""Frames that confirm each other are this far apart: one flash falls on a frame of each finger."""
RECENT_FRAMES = 6
SWITCH_MAX: Vector = (2.0, 2.5, 2.5)
"""The estimates of two fingers differ by no more than this; more is motion of the object."""
DRIFT_S = 3.0
"""A drift of the light below the noise is followed with this time constant; a slip is faster."""


@dataclass(frozen=True, slots=True)
class ContactMotion:
    """Position and rate of the contact.

    Args:
        position: as last estimated. counted: the part of it that has been counted as motion.
        rate: per second, since the grip force last changed. speed: the same, also while it changes.
        noise: standard deviation from frame to frame, learned at rest.
        usual_sigma_deg: smallest sigma of the rotation so far. widening: the present one, relative to it.
        recent: capture times and positions of the last frames, since the grip force last changed.
        offsets: of each set of fingers that has reported since the grip force last changed; the present one is last.
        captured_s, measured_s: of the newest estimate.
    """

    position: Vector = ZERO
    counted: Vector = ZERO
    rate: Vector = ZERO
    speed: Vector = ZERO
    noise: Vector = NOISE_START
    usual_sigma_deg: float = math.inf
    widening: float = 1.0
    recent: tuple[tuple[float, Vector], ...] = ()
    offsets: tuple[tuple[tuple[tuple[str, ...], ...], Vector], ...] = ()
    captured_s: float = -math.inf
    measured_s: float = -math.inf

    @property
    def band(self) -> Vector:
        """The motion that may be noise."""
        deg, down_mm, side_mm = (NOISE_SIGMAS * max(pair) for pair in zip(self.noise, NOISE_LEAST, strict=True))
        return (self.widening * deg, down_mm, side_mm)

    def followed(self, fused: FusedEstimate, *, rests: bool, settled: bool, sure: bool) -> tuple[ContactMotion, Vector]:
        """Return the motion after a new estimate, and what it has moved beyond the noise.

        Args:
            fused: a new estimate.
            rests: nothing should move the object, so the noise can be learned.
            settled: the grip force has not changed since shortly before this frame. While it changes, the imprint
                grows, and no motion counts.
            sure: a leap of a single frame counts: slipguard lifts the object off, and its load arrives.
        """
        seen, offsets = self._seen(fused)
        passed_s = fused.captured_at_s - self.captured_s
        sigma_deg = fused.sigma_deg if fused.sigma_deg is not None else self.usual_sigma_deg
        usual_deg = min(self.usual_sigma_deg, sigma_deg)
        now = replace(
            self,
            position=seen,
            usual_sigma_deg=usual_deg,
            widening=min(sigma_deg / usual_deg, WIDENS_MOST) if 0.0 < usual_deg < math.inf else 1.0,
            offsets=offsets,
            captured_s=max(fused.captured_at_s, self.captured_s),
            measured_s=max(fused.measured_at_s, fused.newest_at_s),
        )
        if passed_s == math.inf:
            return replace(now, counted=seen), ZERO
        change = _minus(seen, self.position)
        now = replace(now, speed=_smoothed(self.speed, change, passed_s))
        if not settled:  # each finger's imprint grows in its own way: what the fingers differ by is found again
            return replace(now, counted=seen, rate=ZERO, recent=(), offsets=offsets[-1:]), ZERO
        if rests:
            now = replace(now, noise=_learned(self.noise, change))
        rate = _smoothed(self.rate, change, passed_s)
        away = _minus(seen, self.counted)
        confirmed = away if sure else self._confirmed(away, fused.captured_at_s)
        moved = _beyond(confirmed, now.band)
        counted = _plus(self.counted, moved)
        if rests and not any(moved):
            followed = 1.0 - math.exp(-max(passed_s, 0.0) / DRIFT_S)
            counted = _vector(c + followed * (p - c) for c, p in zip(counted, seen, strict=True))
        recent = (*self.recent, (fused.captured_at_s, seen))[-RECENT_FRAMES:]
        return replace(now, counted=counted, rate=rate, recent=recent), moved

    def soon(self, ahead_s: float) -> Vector:
        """Return the motion within this time at the present rate, as far as it exceeds the rate's noise."""
        band = _vector(noise * (1.0 + ahead_s / RATE_S) for noise in self.band)
        return _beyond(_vector(ahead_s * one for one in self.rate), band)

    def _seen(self, fused: FusedEstimate) -> tuple[Vector, tuple[tuple[tuple[tuple[str, ...], ...], Vector], ...]]:
        """Return the position as the first fingers would report it, and the offsets of all.

        What is declined stays where it was. A finger that comes and goes must not hide slip, so its offset is fixed
        when it first reports.
        """
        given = (fused.rotation_deg, fused.shift_mm, fused.sideways_mm)
        fingers = (fused.fingers, fused.shift_fingers)
        known = dict(self.offsets)
        if fingers not in known:
            first = not known
            known[fingers] = _vector(
                0.0 if first or value is None else min(max(value - before, -most), most)
                for value, before, most in zip(given, self.position, SWITCH_MAX, strict=True)
            )
        offset = known[fingers] = known.pop(fingers)  # the present one is the last
        seen = _vector(
            before if value is None else value - by
            for value, before, by in zip(given, self.position, offset, strict=True)
        )
        return seen, tuple(known.items())

    def _confirmed(self, away: Vector, captured_s: float) -> Vector:
        """Return the part of a motion that an earlier frame shows, too, or that no single wrong frame explains."""
        earlier = [position for at_s, position in self.recent if captured_s - at_s >= APART_S]
        before = _minus(earlier[-1], self.counted) if earlier else ZERO
        return _vector(
            math.copysign(max(min(abs(one), abs(other)) if one * other > 0.0 else 0.0, abs(one) - leap), one)
            for one, other, leap in zip(away, before, LEAP, strict=True)
        )


def _smoothed(rate: Vector, change: Vector, passed_s: float) -> Vector:
    """Return the smoothed rate after one more change in this time."""
    if passed_s <= 0.0:
        return rate
    share = 1.0 - math.exp(-passed_s / RATE_S)
    return _vector(old + share * (step / passed_s - old) for old, step in zip(rate, change, strict=True))


def _vector(values: Iterable[float]) -> Vector:
    first, second, third = values
    return (first, second, third)


def _plus(one: Vector, other: Vector) -> Vector:
    return _vector(a + b for a, b in zip(one, other, strict=True))


def _minus(one: Vector, other: Vector) -> Vector:
    return _vector(a - b for a, b in zip(one, other, strict=True))


def _beyond(motion: Vector, band: Vector) -> Vector:
    return _vector(math.copysign(max(abs(m) - b, 0.0), m) for m, b in zip(motion, band, strict=True))


def _learned(noise: Vector, change: Vector) -> Vector:
    """Return the noise after one more change between two frames at rest. A leap teaches nothing."""

    def updated(deviation: float, step: float, least: float) -> float:
        if abs(step) > 2.0 * NOISE_SIGMAS * max(deviation, least):
            return deviation
        return math.sqrt(deviation**2 + (0.5 * step**2 - deviation**2) / NOISE_FRAMES)

    return _vector(updated(n, c, least) for n, c, least in zip(noise, change, NOISE_LEAST, strict=True))
