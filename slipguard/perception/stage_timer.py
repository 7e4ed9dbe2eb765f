"""How long each stage of the pipeline took; the clock comes from outside."""

from __future__ import annotations

from collections.abc import Callable


class StageTimer:
    """Collects milliseconds per stage; the same stage may be marked more than once."""

    def __init__(self, timer: Callable[[], float] | None) -> None:
        self._timer = timer
        self.stage_ms: dict[str, float] = {}
        self._since_s = 0.0 if timer is None else timer()

    def mark(self, stage: str) -> None:
        """What ran since the last mark was `stage`."""
        if self._timer is None:
            return
        now_s = self._timer()
        self.stage_ms[stage] = self.stage_ms.get(stage, 0.0) + 1e3 * (now_s - self._since_s)
        self._since_s = now_s
