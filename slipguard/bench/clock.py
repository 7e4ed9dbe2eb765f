"""The bench's clock: a network's answer that is used again for another estimator costs what it cost the first time."""

from __future__ import annotations

import time


class BenchClock:
    """Seconds, as `time.perf_counter`, plus what was added."""

    def __init__(self) -> None:
        self._ahead_s = 0.0

    def __call__(self) -> float:
        """Now."""
        return time.perf_counter() + self._ahead_s

    def add(self, spent_s: float) -> None:
        """As if so much more time had passed."""
        self._ahead_s += spent_s


CLOCK = BenchClock()
