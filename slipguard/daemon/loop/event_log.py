"""The service's messages to people: written to the log, sent to listeners, and the newest kept for the API."""

from __future__ import annotations

import asyncio
import re
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import structlog

from slipguard.daemon.loop.observers import Observers

KEPT = 50
KINDS_MAX = 200
_FIGURES = re.compile(r"\d+(\.\d+)?")
log = structlog.get_logger()


@dataclass(frozen=True, slots=True)
class Event:
    """One event. at_s: loop time. code: of a fault. what_to_do: for the operator."""

    at_s: float
    level: Literal["info", "warning", "fault"]
    text: str
    what_to_do: str | None = None
    code: str | None = None

    @property
    def line(self) -> str:
        """The whole event in one line."""
        return f"fault: {self.text}; {self.what_to_do}" if self.level == "fault" else self.text


class OncePerSecond:
    """Limits messages that differ in figures only to one per second, and counts those held back.

    Remembers at most `KINDS_MAX` kinds of messages.
    """

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}
        self._held_back: dict[str, int] = {}

    def admit(self, text: str, now_s: float) -> int | None:
        """Return None to hold the message back, else how many of its kind were held back since the last one."""
        kind = _FIGURES.sub("#", text)
        if now_s < self._until_s.get(kind, -1e300):
            self._held_back[kind] = self._held_back.get(kind, 0) + 1
            return None
        if len(self._until_s) >= KINDS_MAX:
            self._until_s = {one: until_s for one, until_s in self._until_s.items() if now_s < until_s}
            kinds = {*self._until_s, kind}
            self._held_back = {one: count for one, count in self._held_back.items() if one in kinds}
        self._until_s[kind] = now_s + 1.0
        return self._held_back.pop(kind, 0)


class EventLog:
    """listeners: called with every event. The log gets similar messages once per second only."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        """The newest infos and warnings, oldest first; at most `KEPT`."""
        self.events: deque[Event] = deque(maxlen=KEPT)
        """The newest events, faults included."""
        self.listeners: Observers[Event] = Observers()
        self._limit = OncePerSecond()

    def info(self, text: str) -> None:
        """Report that something happened."""
        self._report(Event(_now_s(), "info", text), log.info)

    def warning(self, text: str) -> None:
        """Report that something went wrong."""
        self._report(Event(_now_s(), "warning", text), log.warning)

    def fault(self, code: str, observed: str, what_to_do: str) -> None:
        """Report a fault when it is latched. Its message was already reported as a warning."""
        log.error("fault", code=code, observed=observed, what_to_do=what_to_do)
        self._publish(Event(_now_s(), "fault", f"{code}: {observed}", what_to_do, code))

    def _report(self, event: Event, write: Callable[..., object]) -> None:
        held_back = self._limit.admit(event.text, event.at_s)
        if held_back is not None:
            write(event.text, **({"similar_held_back": held_back} if held_back else {}))
        self.lines = [*self.lines[1 - KEPT :], event.text]
        self._publish(event)

    def _publish(self, event: Event) -> None:
        self.events.append(event)
        self.listeners.notify(event)


def _now_s() -> float:
    """Return the loop's time, which may be virtual; outside a loop the monotonic clock's."""
    try:
        return asyncio.get_running_loop().time()
    except RuntimeError:
        return time.monotonic()
