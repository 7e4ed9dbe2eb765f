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


EventKind = Literal["grasp", "slip", "device", "system"]
REPEAT_S: dict[EventKind, float] = {"grasp": 1.0, "slip": 1.0, "device": 60.0, "system": 60.0}
"""The log gets messages that differ in figures only at most once in this time; each step of a grasp is worth a line."""


@dataclass(frozen=True, slots=True)
class Event:
    """One event. at_s: loop time. code: of a fault. what_to_do: for the operator. kind: what it is about."""

    at_s: float
    level: Literal["info", "warning", "fault"]
    text: str
    what_to_do: str | None = None
    code: str | None = None
    kind: EventKind = "system"

    @property
    def line(self) -> str:
        """The whole event in one line."""
        return f"fault: {self.text}; {self.what_to_do}" if self.level == "fault" else self.text


class RepetitionLimit:
    """Holds back messages that differ in figures only, and counts them. Remembers at most `KINDS_MAX` messages."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}
        self._held_back: dict[str, int] = {}

    def admit(self, event: Event) -> int | None:
        """Return None to hold the message back, else how many like it were held back since the last one."""
        message, now_s = _FIGURES.sub("#", event.text), event.at_s
        if now_s < self._until_s.get(message, -1e300):
            self._held_back[message] = self._held_back.get(message, 0) + 1
            return None
        if len(self._until_s) >= KINDS_MAX:
            self._until_s = {one: until_s for one, until_s in self._until_s.items() if now_s < until_s}
            while len(self._until_s) >= KINDS_MAX:
                del self._until_s[next(iter(self._until_s))]
            kept = {*self._until_s, message}
            self._held_back = {one: count for one, count in self._held_back.items() if one in kept}
        self._until_s[message] = now_s + REPEAT_S[event.kind]
        return self._held_back.pop(message, 0)


class EventLog:
    """listeners: called with every event. The log gets fewer: see `REPEAT_S`."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        """The newest infos and warnings, oldest first; at most `KEPT`."""
        self.events: deque[Event] = deque(maxlen=KEPT)
        """The newest events, faults included."""
        self.last_slip: Event | None = None
        """The newest event of the kind `slip`."""
        self.listeners: Observers[Event] = Observers()
        self._limit = RepetitionLimit()

    def info(self, text: str, kind: EventKind = "system") -> None:
        """Report that something happened."""
        self._report(Event(_now_s(), "info", text, kind=kind), log.info)

    def warning(self, text: str, kind: EventKind = "system") -> None:
        """Report that something went wrong."""
        self._report(Event(_now_s(), "warning", text, kind=kind), log.warning)

    def fault(self, code: str, observed: str, what_to_do: str) -> None:
        """Report a fault when it is latched. Its message was already reported as a warning."""
        log.error("fault", code=code, observed=observed, what_to_do=what_to_do)
        self._publish(Event(_now_s(), "fault", f"{code}: {observed}", what_to_do, code))

    def _report(self, event: Event, write: Callable[..., object]) -> None:
        held_back = self._limit.admit(event)
        if held_back is not None:
            write(event.text, **({"similar_held_back": held_back} if held_back else {}))
        self.lines = [*self.lines[1 - KEPT :], event.text]
        if event.kind == "slip":
            self.last_slip = event
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
