"""Tracks one finger's rotation since its reference: unwraps it, rejects implausible jumps, estimates the rate."""

from __future__ import annotations

import math
from collections import deque

from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.rotation.fusion import RotationEstimate

RATE_WINDOW_S = 0.10
"""The rate is the slope of the rotations of this period: six frames at 60 Hz."""
RATE_STALE_S = 0.30
"""Older rotations do not contribute to the rate."""
JUMP_DEG = 25.0
JUMP_RATE_DEG_S = 600.0
JUMP_MAX_DEG = 60.0
"""A rotation may differ from the last one by JUMP_DEG plus JUMP_RATE_DEG_S times the time since, at most by
JUMP_MAX_DEG: an axis that jumps by 90 degrees is that of a nearly round patch, not a rotation."""
AHEAD_MAX_DEG = 15.0
"""Largest predicted rotation since the last one."""
STEP_MIN_S = 0.002
"""Frames closer together than this give no rate: their noise over such a time is hundreds of degrees per second."""


class RotationTracker:
    """The rotations of one finger since its reference."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, float]] = deque(maxlen=64)
        self._last: tuple[float, float] = (-math.inf, 0.0)

    @property
    def known_at_s(self) -> float:
        """When the rotation was last measured or found unchanged; -infinity before the reference."""
        return self._history[-1][0] if self._history else -math.inf

    def start(self, now_s: float, rotation_deg: float = 0.0) -> None:
        """Set the rotation since the reference at `now_s`; 0 if the reference is taken then."""
        self._history.clear()
        self._history.append((now_s, rotation_deg))
        self._last = (now_s, rotation_deg)

    def predicted_deg(self, now_s: float) -> float:
        """Return the rotation at `now_s` for a constant rate; at most `AHEAD_MAX_DEG` ahead."""
        rate = self.rate_deg_s(now_s)
        last_s, rotation = self._last
        if rate is None or not math.isfinite(last_s):
            return rotation
        return rotation + min(max(rate * max(now_s - last_s, 0.0), -AHEAD_MAX_DEG), AHEAD_MAX_DEG)

    def accept(self, now_s: float, rotation: RotationEstimate) -> RotationEstimate:
        """Add a rotation measured at `now_s` to the history, or decline it as implausible."""
        if rotation.rotation_deg is None or rotation.sigma_deg is None:
            return rotation
        if not (math.isfinite(rotation.rotation_deg) and math.isfinite(rotation.sigma_deg)):
            return RotationEstimate(None, None, DeclineReason.NOT_A_NUMBER)
        last_s, last = self._last
        since_s = max(now_s - last_s, 0.0) if math.isfinite(last_s) else 0.0
        allowed = min(JUMP_DEG + JUMP_RATE_DEG_S * since_s, JUMP_MAX_DEG)
        if abs(rotation.rotation_deg - last) > allowed:
            detail = f"{rotation.rotation_deg - last:+.0f} deg within {since_s:.3f} s, limit {allowed:.0f} deg"
            return RotationEstimate(None, None, explain(DeclineReason.JUMP, detail))
        self._last = (now_s, rotation.rotation_deg)
        self._append(now_s, rotation.rotation_deg)
        return rotation

    def unchanged(self, now_s: float) -> None:
        """Note that the image at `now_s` shows no change: the rotation is still the last one."""
        if self._history:
            self._append(now_s, self._history[-1][1])

    def _append(self, now_s: float, rotation_deg: float) -> None:
        """Add to the history; if the clock went back, entries after `now_s` are useless for rates and removed."""
        while self._history and self._history[-1][0] > now_s:
            self._history.pop()
        if not self._history or now_s - self._history[-1][0] >= STEP_MIN_S:
            self._history.append((now_s, rotation_deg))

    def rate_deg_s(self, now_s: float) -> float | None:
        """Return the slope over the last `RATE_WINDOW_S`, over at least three rotations; None with fewer."""
        recent = [(t, v) for t, v in self._history if now_s - t <= RATE_STALE_S]
        within = [(t, v) for t, v in recent if now_s - t <= RATE_WINDOW_S + 1e-9]
        points = within if len(within) >= 3 else recent[-3:]
        if len(points) < 3:
            return None
        mean_t = sum(t for t, _ in points) / len(points)
        mean_v = sum(v for _, v in points) / len(points)
        spread = sum((t - mean_t) ** 2 for t, _ in points)
        return sum((t - mean_t) * (v - mean_v) for t, v in points) / spread
