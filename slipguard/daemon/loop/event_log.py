"""What the service says to people: to the log, to whoever listens, and the newest lines kept for a look."""

from __future__ import annotations

import asyncio
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import structlog

from slipguard.daemon.logging import OncePerSecond

KEPT = 50
log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Event:
    """One thing that happened. at_s: of the loop's clock. code: a fault's. what_to_do: for the person at the cell."""

    at_s: float
    level: Literal["info", "warning", "fault"]
    text: str
    what_to_do: str | None = None
    code: str | None = None

    @property
    def line(self) -> str:
        """All of it in one line."""
        return f"fault: {self.text}; {self.what_to_do}" if self.level == "fault" else self.text


class EventLog:
    """listeners: called with each event.

    They hear every line; of those that differ in figures only, the log has one a second.
    """

    def __init__(self) -> None:
        self.lines: list[str] = []
        """The newest ones, oldest first; at most `KEPT`."""
        self.events: deque[Event] = deque(maxlen=KEPT)
        """The newest ones, faults too."""
        self.listeners: list[Callable[[Event], None]] = []
        self._limit = OncePerSecond()

    def info(self, text: str) -> None:
        """One line of what happens."""
        self._log(log.info, text)
        self._line(Event(_now_s(), "info", text))

    def warning(self, text: str) -> None:
        """One line of what did not go as it should."""
        self._log(log.warning, text)
        self._line(Event(_now_s(), "warning", text))

    def fault(self, code: str, seen: str, do: str) -> None:
        """A fault as it is latched; its line was said already."""
        log.error("fault", code=code, seen=seen, do=do)
        self._tell(Event(_now_s(), "fault", f"{code}: {seen}", do, code))

    def _log(self, write: Callable[..., object], text: str) -> None:
        held_back = self._limit.admit(text, _now_s())
        if held_back is not None:
            write(text, **({"alike_before": held_back} if held_back else {}))

    def _line(self, event: Event) -> None:
        self.lines = [*self.lines[1 - KEPT :], event.text]
        self._tell(event)

    def _tell(self, event: Event) -> None:
        self.events.append(event)
        for listener in self.listeners:
            listener(event)


def _now_s() -> float:
    """The loop's clock, which may be a virtual one; outside a loop the clock it usually is."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()
