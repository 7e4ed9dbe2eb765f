"""From axes and alignments to one signed, unwrapped turn since the reference, its sigma and its rate."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from slipguard.perception.rotation.axial_angle import nearest_rotation_deg

RATE_WINDOW_S = 0.10
"""The rate is the slope of the turns of this long: six frames at 60 Hz."""
RATE_STALE_S = 0.30
"""Turns older than this tell nothing about the rate now."""
JUMP_DEG = 25.0
JUMP_RATE_DEG_S = 600.0
JUMP_MAX_DEG = 60.0
"""A turn may differ from the last one by JUMP_DEG plus JUMP_RATE_DEG_S times the time since, never by JUMP_MAX_DEG: an
axis that jumps by a right angle is a round patch that changed its mind, not a turn."""
STEP_MIN_S = 0.002
"""Frames closer together than this tell no rate: their noise over so short a time is hundreds of degrees a second."""
AGREE_SIGMA = 3.0
DISAGREE_DEG = 8.0
ALONE_DEG = 4.0
"""An outline that no axis bears out and that is less sure than this fits as well further on (a ring cut by the frame):
it would be found wherever it is looked for, each time a little further."""
UNSURE_ALONE = "outline too uncertain alone"
IMPLAUSIBLE = "implausible jump"
NO_NUMBER = "not a number"
DISAGREE = "estimators disagree"


@dataclass(frozen=True, slots=True)
class RotationEstimate:
    """A turn since the reference, degrees counter-clockwise, one standard deviation; declined: why there is none."""

    rotation_deg: float | None
    sigma_deg: float | None
    declined: str | None = None


def rotation_between_axes(
    now_deg: float, now_sigma_deg: float, reference_deg: float, reference_sigma_deg: float, near_deg: float
) -> RotationEstimate:
    """The turn between two axes, of all that differ by half turns the one nearest `near_deg`.

    From -6 to +6 it is +12, from 80 to 100 (the axis -80) it is +20.
    """
    rotation = nearest_rotation_deg(now_deg - reference_deg, near_deg)
    return RotationEstimate(rotation, math.hypot(now_sigma_deg, reference_sigma_deg))


def checked(laid: RotationEstimate, axial: RotationEstimate) -> RotationEstimate:
    """The turn by registration, checked by the one that the axes show.

    Both come from one mask and err together, so their mean would be no better than the surer: that is registration's
    unless its sigma is half as large again. Where they differ by more than both sigmas allow, sigma covers both;
    far apart, there is no turn. An axis alone is taken as it is, registration alone up to a sigma of `ALONE_DEG`; where
    both are declined, registration's reason counts.
    """
    if laid.rotation_deg is None or laid.sigma_deg is None:
        return axial if axial.rotation_deg is not None else laid
    if axial.rotation_deg is None or axial.sigma_deg is None:
        return laid if laid.sigma_deg <= ALONE_DEG else RotationEstimate(None, None, UNSURE_ALONE)
    apart = abs(laid.rotation_deg - axial.rotation_deg)
    surer = laid if laid.sigma_deg <= 1.5 * axial.sigma_deg else axial
    if apart <= AGREE_SIGMA * math.hypot(laid.sigma_deg, axial.sigma_deg):
        return surer
    if apart > DISAGREE_DEG:
        return RotationEstimate(None, None, DISAGREE)
    return RotationEstimate(surer.rotation_deg, max(surer.sigma_deg or 0.0, 0.5 * apart))


def combined(relief: RotationEstimate, outline: RotationEstimate) -> RotationEstimate:
    """One turn from the relief inside a contact and from its outline, which err apart: the mean by 1 / sigma^2.

    One alone is taken as it is; where both are declined, the relief's reason counts. Where they differ by more than
    both sigmas allow the surer is taken, with a sigma that covers both; far apart, there is no turn.
    """
    if relief.rotation_deg is None or relief.sigma_deg is None:
        return outline if outline.rotation_deg is not None else relief
    if outline.rotation_deg is None or outline.sigma_deg is None:
        return relief
    apart = abs(relief.rotation_deg - outline.rotation_deg)
    if apart > AGREE_SIGMA * math.hypot(relief.sigma_deg, outline.sigma_deg):
        if apart > DISAGREE_DEG:
            return RotationEstimate(None, None, DISAGREE)
        surer = relief if relief.sigma_deg <= outline.sigma_deg else outline
        return RotationEstimate(surer.rotation_deg, max(surer.sigma_deg or 0.0, 0.5 * apart))
    trust, other = relief.sigma_deg**-2, outline.sigma_deg**-2
    mean = (trust * relief.rotation_deg + other * outline.rotation_deg) / (trust + other)
    return RotationEstimate(mean, (trust + other) ** -0.5)


def pooled(rotations: Sequence[RotationEstimate]) -> RotationEstimate:
    """One turn from those of several estimators of axes: the surest, averaged with all that agree with it.

    One that does not agree is left out but widens sigma. Declined, for the first one's reason, where all are.
    """
    said = [(t.rotation_deg, t.sigma_deg) for t in rotations if t.rotation_deg is not None and t.sigma_deg is not None]
    if not said:
        return rotations[0]
    best, sigma = min(said, key=lambda one: one[1])
    total = weights = 0.0
    widened = sigma
    for value, own in said:
        apart = abs(value - best)
        if apart <= AGREE_SIGMA * math.hypot(own, sigma):
            total += value / own**2
            weights += 1.0 / own**2
        else:
            widened = max(widened, apart / 4.0)
    return RotationEstimate(total / weights, widened)


def less_sure(by_outline: RotationEstimate, unlike: float) -> RotationEstimate:
    """The outline of a contact that has deformed is off by more than it shows."""
    if by_outline.sigma_deg is None:
        return by_outline
    return RotationEstimate(by_outline.rotation_deg, unlike * by_outline.sigma_deg)


def agree(by_relief: RotationEstimate, axial: RotationEstimate) -> bool:
    """Whether the patch's axis, where it has one, does not contradict the relief."""
    if (
        by_relief.rotation_deg is None
        or by_relief.sigma_deg is None
        or axial.rotation_deg is None
        or axial.sigma_deg is None
    ):
        return True
    return abs(by_relief.rotation_deg - axial.rotation_deg) <= AGREE_SIGMA * math.hypot(
        by_relief.sigma_deg, axial.sigma_deg
    )


class RotationTracker:
    """Remembers the turns of one finger since its reference."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, float]] = deque(maxlen=64)
        self._last: tuple[float, float] = (-math.inf, 0.0)

    @property
    def known_at_s(self) -> float:
        """When the turn was last measured or seen unchanged; -infinity before the reference."""
        return self._history[-1][0] if self._history else -math.inf

    @property
    def last_rotation_deg(self) -> float:
        """The last turn accepted; 0 at the reference."""
        return self._last[1]

    def start(self, now_s: float, rotation_deg: float = 0.0) -> None:
        """The turn since the reference is `rotation_deg` at `now_s`; 0 where it is taken just then."""
        self._history.clear()
        self._history.append((now_s, rotation_deg))
        self._last = (now_s, rotation_deg)

    def predicted_deg(self, now_s: float) -> float:
        """Where the turn would be at `now_s` if the rate stayed; never more than 15 degrees ahead."""
        rate = self.rate_deg_s(now_s)
        last_s, rotation = self._last
        if rate is None or not math.isfinite(last_s):
            return rotation
        return rotation + min(max(rate * max(now_s - last_s, 0.0), -15.0), 15.0)

    def accept(self, now_s: float, rotation: RotationEstimate) -> RotationEstimate:
        """Take a turn measured at `now_s` into the history, or decline it as implausible."""
        if rotation.rotation_deg is None or rotation.sigma_deg is None:
            return rotation
        if not (math.isfinite(rotation.rotation_deg) and math.isfinite(rotation.sigma_deg)):
            return RotationEstimate(None, None, NO_NUMBER)
        last_s, last = self._last
        since_s = max(now_s - last_s, 0.0) if math.isfinite(last_s) else 0.0
        allowed = min(JUMP_DEG + JUMP_RATE_DEG_S * since_s, JUMP_MAX_DEG)
        if abs(rotation.rotation_deg - last) > allowed:
            return RotationEstimate(None, None, IMPLAUSIBLE)
        self._last = (now_s, rotation.rotation_deg)
        self._remember(now_s, rotation.rotation_deg)
        return rotation

    def unchanged(self, now_s: float) -> None:
        """The picture at `now_s` shows no change: the turn is still the last one."""
        if self._history:
            self._remember(now_s, self._history[-1][1])

    def _remember(self, now_s: float, rotation_deg: float) -> None:
        """A clock that went back makes what came after `now_s` worthless for rates."""
        while self._history and self._history[-1][0] > now_s:
            self._history.pop()
        if not self._history or now_s - self._history[-1][0] >= STEP_MIN_S:
            self._history.append((now_s, rotation_deg))

    def rate_deg_s(self, now_s: float) -> float | None:
        """Slope of the turns of the last `RATE_WINDOW_S`, of at least the last three; None where there are too few."""
        recent = [(t, v) for t, v in self._history if now_s - t <= RATE_STALE_S]
        within = [(t, v) for t, v in recent if now_s - t <= RATE_WINDOW_S + 1e-9]
        points = within if len(within) >= 3 else recent[-3:]
        if len(points) < 3:
            return None
        mean_t = sum(t for t, _ in points) / len(points)
        mean_v = sum(v for _, v in points) / len(points)
        spread = sum((t - mean_t) ** 2 for t, _ in points)
        return sum((t - mean_t) * (v - mean_v) for t, v in points) / spread
