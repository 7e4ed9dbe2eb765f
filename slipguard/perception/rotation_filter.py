"""The rotation since the reference over time: which of several possible rotations it is, and the rate.

A registration measures the rotation up to what the texture cannot tell apart (periods, symmetries, similar parts). The
filter weighs the hypotheses: a motion prior, limited by the largest acceleration, times the likelihood of each
registration. A gap only widens the prior. While a second hypothesis keeps more than a few percent, the rotation is
declined, and the hypotheses move on together.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

from slipguard.perception.estimate import DeclineReason, RotationEstimate, explain

ACCELERATION_DEG_S2 = 20_000.0
"""Largest assumed acceleration of an object that rotates between two frames: a rod of 8 cm that is held at its end
without any force reaches half of it. Teeth as fine as 26 are counted across one lost frame at 60 Hz, not at 30 Hz."""
FREE_DEG = 0.15
"""Noise of a rotation that is no acceleration."""
REACH_SIGMAS = 2.5
"""The largest credible way from the predicted rotation, in standard deviations of the motion prior."""
UNSEEN_DEG = 45.0
"""Standard deviation of the rotation of an object that has been held while nothing measured it: what falls by more is
lost."""
SECOND_MAX = 0.05
"""Largest probability of all other hypotheses together."""
AHEAD_MAX_DEG = 45.0
"""Largest predicted rotation since the last one."""
JUMP_DEG = 15.0
"""Largest jump of a contact that deforms beyond the credible rotation."""
RATE_WINDOW_S = 0.10
"""The rate is the slope of the rotations of this period: six frames at 60 Hz."""
RATE_STALE_S = 0.30
"""Older rotations do not contribute to the rate."""
STEP_MIN_S = 0.002
"""Frames closer together than this give no rate: their noise over such a time is hundreds of degrees per second."""


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A rotation that a registration has found, degrees, and its log likelihood, comparable within a frame."""

    rotation_deg: float
    log_likelihood: float


class RotationFilter:
    """The rotations of one finger since its reference.

    A bar looks the same after half a revolution; from one frame to the next it cannot have made one:

    >>> rotations = RotationFilter()
    >>> rotations.start(now_s=0.0)
    >>> rotations.update(1 / 60, [Hypothesis(1.0, 0.0), Hypothesis(-179.0, 0.0)]).rotation_deg
    1.0
    """

    def __init__(self) -> None:
        self._history: deque[tuple[float, float]] = deque(maxlen=64)
        self.last_deg = 0.0
        """The last known rotation, of several hypotheses the most probable; 0 before the reference."""
        self._known_at_s = -math.inf
        self._unexpected_deg = 0.0
        self._unseen = False
        self.others_deg: list[float] = []
        """The other hypotheses, from the most probable one."""

    def start(self, now_s: float, rotation_deg: float = 0.0, unseen: bool = False) -> None:
        """Set the rotation at `now_s`. unseen: the object has been held unseen since then."""
        self._history.clear()
        self._history.append((now_s, rotation_deg))
        self.last_deg = rotation_deg
        self._known_at_s = now_s
        self._unexpected_deg = 0.0
        self._unseen = unseen
        self.others_deg = []

    def predicted_deg(self, now_s: float) -> float:
        """Return the rotation at `now_s` for the rate between the last two frames."""
        ahead_deg = self._last_rate_deg_s * self._gap_s(now_s)
        return self.last_deg + min(max(ahead_deg, -AHEAD_MAX_DEG), AHEAD_MAX_DEG)

    def reach_deg(self, now_s: float) -> float:
        """Return how far the object may be from the predicted rotation; at most 180.

        It may have stopped at once, or accelerate. If the acceleration began within the last frame, the rate at its end
        was higher than its mean rate.
        """
        if self._unseen:
            return 180.0
        gap_s = self._gap_s(now_s)
        begun_deg = max(self._unexpected_deg - FREE_DEG, 0.0)
        lag_deg_s = min(math.sqrt(2.0 * ACCELERATION_DEG_S2 * begun_deg), 0.5 * ACCELERATION_DEG_S2 * gap_s)
        faster_deg = lag_deg_s * gap_s + 0.5 * ACCELERATION_DEG_S2 * gap_s**2
        return min(max(abs(self._last_rate_deg_s) * gap_s, faster_deg), 180.0)

    def credible(self, now_s: float, rotation_deg: float, others_deg: Sequence[float]) -> list[float]:
        """Return which of others, relative to a rotation, the motion makes not much less probable than it."""
        least = self._log_prior(now_s, rotation_deg) + math.log(SECOND_MAX)
        return [by_deg for by_deg in others_deg if self._log_prior(now_s, rotation_deg + by_deg) > least]

    def update(self, now_s: float, found: Sequence[Hypothesis]) -> RotationEstimate:
        """Return the most probable of the rotations found in the frame of `now_s`, without sigma, or decline.

        Args:
            now_s: Capture time of the frame.
            found: What registrations have found, at least one.
        """
        if not all(math.isfinite(one.rotation_deg) and math.isfinite(one.log_likelihood) for one in found):
            return RotationEstimate(None, None, explain(DeclineReason.UNCERTAIN, "not a number"))
        prior = {one: self._log_prior(now_s, one.rotation_deg) for one in found}
        best, *rest = sorted(found, key=lambda one: -(prior[one] + one.log_likelihood))
        away_deg = best.rotation_deg - self.predicted_deg(now_s)
        limit_deg = self.reach_deg(now_s) + JUMP_DEG
        if not self.others_deg and abs(away_deg) > limit_deg:
            detail = f"{away_deg:+.0f} deg from the expected rotation, limit {limit_deg:.0f} deg"
            return RotationEstimate(None, None, explain(DeclineReason.UNCERTAIN, detail))
        highest = prior[best] + best.log_likelihood
        odds = sum(math.exp(prior[one] + one.log_likelihood - highest) for one in rest)
        ambiguous = odds > SECOND_MAX * (1.0 + odds)
        if self._unseen or (self.others_deg and abs(away_deg) > limit_deg):  # it did not come from the last one
            self._history.clear()
        self.others_deg = [one.rotation_deg - best.rotation_deg for one in rest if ambiguous]
        self._unseen = False
        self._unexpected_deg = abs(away_deg) if abs(away_deg) <= limit_deg else 0.0
        self.last_deg = best.rotation_deg
        self._append(now_s, best.rotation_deg)
        if ambiguous:
            detail = f"{best.rotation_deg:+.0f} and {rest[0].rotation_deg:+.0f} deg"
            return RotationEstimate(None, None, explain(DeclineReason.SEVERAL_ROTATIONS, detail))
        return RotationEstimate(best.rotation_deg, None)

    def unchanged(self, now_s: float) -> None:
        """Note that the image at `now_s` shows no change: the rotation is still the last one."""
        if self._history:
            self._unexpected_deg = 0.0
            self._append(now_s, self._history[-1][1])

    def note_kept(self, now_s: float) -> None:
        """Note that the frame of `now_s` is not measured, and that its rotation is known to be unchanged."""
        self._known_at_s = now_s

    def rate_deg_s(self, now_s: float) -> float | None:
        """Return the slope over the last `RATE_WINDOW_S`, over at least three rotations; None with fewer."""
        points: list[tuple[float, float]] = []
        for at_s, rotation_deg in reversed(self._history):
            if now_s - at_s > (RATE_WINDOW_S + 1e-9 if len(points) >= 3 else RATE_STALE_S):
                break
            points.append((at_s, rotation_deg))
        if len(points) < 3:
            return None
        mean_t = sum(t for t, _ in points) / len(points)
        mean_v = sum(v for _, v in points) / len(points)
        spread = sum((t - mean_t) ** 2 for t, _ in points)
        return sum((t - mean_t) * (v - mean_v) for t, v in points) / spread

    def _log_prior(self, now_s: float, rotation_deg: float) -> float:
        """Return the log probability of a rotation at `now_s` by the motion alone, up to a constant."""
        away_deg = rotation_deg - self.predicted_deg(now_s)
        if self.others_deg:  # unknown by a rotation that the texture cannot tell: only the images can decide
            return 0.0
        if self._unseen:
            return -0.5 * (away_deg / UNSEEN_DEG) ** 2
        return -0.5 * (away_deg / (self.reach_deg(now_s) / REACH_SIGMAS + FREE_DEG)) ** 2

    @property
    def _last_rate_deg_s(self) -> float:
        """The rate between the last two frames; 0 if they are too far apart."""
        if len(self._history) < 2:
            return 0.0
        (before_s, before), (last_s, last) = self._history[-2], self._history[-1]
        return (last - before) / (last_s - before_s) if last_s - before_s <= RATE_STALE_S else 0.0

    def _gap_s(self, now_s: float) -> float:
        return max(now_s - self._known_at_s, 0.0) if math.isfinite(self._known_at_s) else 0.0

    def _append(self, now_s: float, rotation_deg: float) -> None:
        """Add to the history; if the clock went back, entries after `now_s` are useless for rates and removed."""
        while self._history and self._history[-1][0] > now_s:
            self._history.pop()
        self._known_at_s = now_s
        if not self._history or now_s - self._history[-1][0] >= STEP_MIN_S:
            self._history.append((now_s, rotation_deg))
