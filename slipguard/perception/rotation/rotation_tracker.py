"""Tracks one finger's rotation since its reference: unwraps it, rejects implausible jumps, estimates the rate."""

from __future__ import annotations

import math
from collections import deque

from slipguard.perception.declined import DeclineReason, explain
from slipguard.perception.estimate import UnconfirmedRotation
from slipguard.perception.rotation.axial_angle import nearest_rotation_deg
from slipguard.perception.rotation.fusion import RotationEstimate

RATE_WINDOW_S = 0.10
"""The rate is the slope of the rotations of this period: six frames at 60 Hz."""
RATE_STALE_S = 0.30
"""Older rotations do not contribute to the rate."""
JUMP_DEG = 25.0
JUMP_RATE_DEG_S = 600.0
JUMP_MAX_DEG = 60.0
"""A rotation may differ from the last one by JUMP_DEG plus JUMP_RATE_DEG_S times the time since, at most by
JUMP_MAX_DEG: an axis that jumps by 90 degrees is that of a nearly round patch, not a rotation. A larger jump is only
offered to the other finger, which may confirm it."""
GAP_S = 0.15
"""After a longer time without a rotation, one that is further than REGAINED_DEG (and three sigmas) from the last one
counts only when AGREEING_FRAMES in a row agree on it."""
REGAINED_DEG = 2.0
AGREEING_FRAMES = 3
AGREE_DEG = 6.0
"""Two frames in a row agree within REGAINED_DEG plus three sigmas, at most within this."""
AHEAD_MAX_DEG = 15.0
"""Largest predicted rotation since the last one."""
STEP_MIN_S = 0.002
"""Frames closer together than this give no rate: their noise over such a time is hundreds of degrees per second."""


class RotationTracker:
    """The rotations of one finger since its reference."""

    def __init__(self) -> None:
        self._history: deque[tuple[float, float]] = deque(maxlen=64)
        self._last: tuple[float, float] = (-math.inf, 0.0)
        self._offered: deque[tuple[float, float, float]] = deque(maxlen=AGREEING_FRAMES)
        self._kept_at_s = -math.inf
        self._unexpected_deg = 0.0

    @property
    def known_at_s(self) -> float:
        """When the rotation was last measured or found unchanged; -infinity before the reference."""
        return max(self._history[-1][0], self._kept_at_s) if self._history else -math.inf

    @property
    def last_deg(self) -> float:
        """The last known rotation; 0 before the reference."""
        return self._last[1]

    @property
    def unexpected_deg(self) -> float:
        """How far the last rotation was from the one that the two before it let expect: how fast the rate changes."""
        return self._unexpected_deg

    @property
    def offered_deg(self) -> float | None:
        """The rotation that several frames in a row agree on although it is an implausible jump; None without one."""
        return self._offered[-1][1] if len(self._offered) == AGREEING_FRAMES else None

    def start(self, now_s: float, rotation_deg: float = 0.0) -> None:
        """Set the rotation since the reference at `now_s`; 0 if the reference is taken then."""
        self._history.clear()
        self._offered.clear()
        self._history.append((now_s, rotation_deg))
        self._last = (now_s, rotation_deg)
        self._kept_at_s = -math.inf
        self._unexpected_deg = 0.0

    def predicted_deg(self, now_s: float) -> float:
        """Return the rotation at `now_s` for a constant rate; at most `AHEAD_MAX_DEG` ahead."""
        if self.offered_deg is not None:
            return self.offered_deg
        rate = self.rate_deg_s(now_s)
        last_s, rotation = self._last
        if rate is None or not math.isfinite(last_s):
            return rotation
        return rotation + min(max(rate * max(now_s - last_s, 0.0), -AHEAD_MAX_DEG), AHEAD_MAX_DEG)

    def extrapolated_deg(self, now_s: float) -> float:
        """Return the rotation at `now_s` for the rate between the last two frames, which lags by half a frame only."""
        last_s, rotation = self._last
        since_s = max(now_s - max(last_s, self._kept_at_s), 0.0) if math.isfinite(last_s) else 0.0
        return rotation + self.last_rate_deg_s * since_s

    @property
    def last_rate_deg_s(self) -> float:
        """The rate between the last two frames; 0 if they are too far apart."""
        if len(self._history) < 2:
            return 0.0
        (before_s, before), (last_s, last) = self._history[-2], self._history[-1]
        return (last - before) / (last_s - before_s) if last_s - before_s <= GAP_S else 0.0

    def accept(self, now_s: float, rotation: RotationEstimate, by_texture: bool = False) -> RotationEstimate:
        """Add a rotation measured at `now_s` to the history, or decline it as implausible.

        Args:
            now_s: Capture time of the frame.
            rotation: As measured.
            by_texture: The texture shows it, so that it is not ambiguous by 180 degrees as an axis is.
        """
        if rotation.rotation_deg is None or rotation.sigma_deg is None:
            self._offered.clear()
            return rotation
        if not (math.isfinite(rotation.rotation_deg) and math.isfinite(rotation.sigma_deg)):
            return RotationEstimate(None, None, DeclineReason.NOT_A_NUMBER)
        last_s, last = self._last
        since_s = max(now_s - last_s, 0.0) if math.isfinite(last_s) else 0.0
        moved_deg = rotation.rotation_deg - last
        allowed = min(JUMP_DEG + JUMP_RATE_DEG_S * since_s, JUMP_MAX_DEG)
        regained = now_s - self.known_at_s > GAP_S and abs(moved_deg) > REGAINED_DEG + 3.0 * rotation.sigma_deg
        if abs(moved_deg) > allowed or regained:
            agreeing = self._offer(now_s, rotation.rotation_deg, rotation.sigma_deg, by_texture)
            if abs(moved_deg) > allowed:
                detail = f"{moved_deg:+.0f} deg within {since_s:.3f} s, limit {allowed:.0f} deg"
                offer = self._unconfirmed(by_texture) if agreeing else None
                return RotationEstimate(None, None, explain(DeclineReason.JUMP, detail), offer)
            if not agreeing:
                detail = f"{moved_deg:+.0f} deg in {len(self._offered)} frames, needed {AGREEING_FRAMES}"
                return RotationEstimate(None, None, explain(DeclineReason.REGAINED, detail))
        self._offered.clear()
        self._unexpected_deg = abs(rotation.rotation_deg - self.extrapolated_deg(now_s))
        self._last = (now_s, rotation.rotation_deg)
        self._append(now_s, rotation.rotation_deg)
        return rotation

    def unchanged(self, now_s: float) -> None:
        """Note that the image at `now_s` shows no change: the rotation is still the last one."""
        if self._history:
            self._unexpected_deg = 0.0
            self._append(now_s, self._history[-1][1])

    def note_kept(self, now_s: float) -> None:
        """Note that the frame of `now_s` is not measured, and that its rotation is known to be unchanged."""
        self._kept_at_s = now_s

    def _offer(self, now_s: float, rotation_deg: float, sigma_deg: float, by_texture: bool) -> bool:
        """Return whether enough frames in a row agree on a rotation that is far from the last accepted one."""
        if self._offered and now_s - self._offered[-1][0] > GAP_S:
            self._offered.clear()
        if self._offered:
            _, before_deg, before_sigma_deg = self._offered[-1]
            if not by_texture:
                rotation_deg = nearest_rotation_deg(rotation_deg, before_deg)
            within_deg = min(REGAINED_DEG + 3.0 * math.hypot(sigma_deg, before_sigma_deg), AGREE_DEG)
            if abs(rotation_deg - before_deg) > within_deg:
                self._offered.clear()
        self._offered.append((now_s, rotation_deg, sigma_deg))
        return len(self._offered) == AGREEING_FRAMES

    def _unconfirmed(self, by_texture: bool) -> UnconfirmedRotation:
        (first_s, first_deg, _), (last_s, last_deg, sigma_deg) = self._offered[0], self._offered[-1]
        rate_deg_s = (last_deg - first_deg) / max(last_s - first_s, STEP_MIN_S)
        return UnconfirmedRotation(last_deg, sigma_deg, rate_deg_s, axial=not by_texture)

    def _append(self, now_s: float, rotation_deg: float) -> None:
        """Add to the history; if the clock went back, entries after `now_s` are useless for rates and removed."""
        while self._history and self._history[-1][0] > now_s:
            self._history.pop()
        self._kept_at_s = min(self._kept_at_s, now_s)
        if not self._history or now_s - self._history[-1][0] >= STEP_MIN_S:
            self._history.append((now_s, rotation_deg))

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
