"""What the service says to people: to the log, to whoever listens, and the newest lines kept for a look."""

from __future__ import annotations

from collections.abc import Callable

import structlog

KEPT = 50
log = structlog.get_logger()


class Journal:
    """listeners: called with the line and whether it tells of an error."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        """The newest ones, oldest first; at most `KEPT`."""
        self.listeners: list[Callable[[str, bool], None]] = []

    def say(self, text: str) -> None:
        """One line of what happens."""
        log.info(text)
        self.lines = [*self.lines[1 - KEPT :], text]
        self._tell(text, False)

    def warn(self, text: str) -> None:
        log.warning(text)

    def fault(self, code: str, seen: str, do: str) -> None:
        """A fault as it is latched; its line was said already."""
        log.error("fault", code=code, seen=seen, do=do)
        self._tell(f"fault: {code}: {seen}; {do}", True)

    def _tell(self, text: str, error: bool) -> None:
        for listener in self.listeners:
            listener(text, error)
