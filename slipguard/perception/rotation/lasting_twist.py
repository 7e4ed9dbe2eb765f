"""For how long a middle that has rotated by itself makes the rotation uncertain."""

from __future__ import annotations

from collections import deque

TWIST_S = 0.25
"""A middle that has rotated differently counts for this long if the rest then follows it: the object has rotated
further than what is seen, although nothing shows it any more."""
REST_DEG_S = 5.0
"""Time at rest does not count: below this rate nothing moves that could show how far the object has rotated."""


class LastingTwist:
    """The twists of the last `TWIST_S` of motion."""

    def __init__(self) -> None:
        self._seen: deque[tuple[float, float, float]] = deque()
        self._moved_s = 0.0
        self._last_s: float | None = None

    def largest_deg(self, now_s: float, twist_deg: float, rotation_deg: float, rate_deg_s: float | None) -> float:
        """Add the twist at `now_s` and return the largest one; an earlier one counts up to the rotation since then.

        twist_deg: sigma by a middle that rotates by itself. rate_deg_s: rate of the rotation; None if unknown.
        """
        rests = rate_deg_s is not None and abs(rate_deg_s) < REST_DEG_S
        if self._last_s is not None and not rests:
            self._moved_s += max(now_s - self._last_s, 0.0)
        self._last_s = now_s
        if not rests or not self._seen:
            while self._seen and self._moved_s - self._seen[0][0] > TWIST_S:
                self._seen.popleft()
            self._seen.append((self._moved_s, twist_deg, rotation_deg))
        return max(twist_deg, *(min(twist, abs(rotation_deg - then_deg)) for _, twist, then_deg in self._seen))
