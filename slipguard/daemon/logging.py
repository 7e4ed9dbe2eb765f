"""Logging: JSON lines where a program reads (a journal, a pipe), colours where a person does."""

from __future__ import annotations

import contextlib
import logging
import re
import sys
from typing import TextIO, cast

import structlog

KINDS_MAX = 200
_FIGURES = re.compile(r"\d+(\.\d+)?")


def configure(*, json_lines: bool | None = None, level: int = logging.INFO) -> None:
    """Set structlog up once, to stderr; `json_lines` None: JSON unless stderr is a terminal."""
    as_json = not sys.stderr.isatty() if json_lines is None else json_lines
    renderer: structlog.typing.Processor = (
        structlog.processors.JSONRenderer()
        if as_json
        else structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(),
            exception_formatter=structlog.dev.plain_traceback,  # the rich one prints locals, the token among them
        )
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.PrintLoggerFactory(cast(TextIO, _Forgiving(sys.stderr))),
        cache_logger_on_first_use=False,
    )


def set_level(level: str) -> None:
    """Let through what is as grave as `level` (debug, info, warning, error) or graver."""
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()])
    )


class OncePerSecond:
    """Lets one line of each kind through per second; says how many were held back. Lines of one kind differ in figures.

    Remembers no more than `KINDS_MAX` kinds, whatever is said in years.
    """

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def admit(self, text: str, now_s: float) -> int | None:
        """None: hold it back. Else how many of its kind were held back since the last one let through."""
        kind = _FIGURES.sub("#", text)
        if now_s < self._until_s.get(kind, -1e300):
            self._held[kind] = self._held.get(kind, 0) + 1
            return None
        if len(self._until_s) >= KINDS_MAX:
            self._until_s = {known: until_s for known, until_s in self._until_s.items() if now_s < until_s}
            self._held = {known: held for known, held in self._held.items() if known in self._until_s or known == kind}
        self._until_s[kind] = now_s + 1.0
        return self._held.pop(kind, 0)


class _Forgiving:
    """A stream whose failures are nobody's: a terminal that was closed, a full disk behind stderr."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, text: str) -> int:
        """As far as that is possible."""
        with contextlib.suppress(OSError, ValueError):
            return self._stream.write(text)
        return len(text)

    def flush(self) -> None:
        """As far as that is possible."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.flush()
