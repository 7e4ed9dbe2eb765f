"""Logging: JSON lines where a program reads (a journal, a pipe), colours where a person does."""

from __future__ import annotations

import logging
import sys

import structlog


def configure(*, json_lines: bool | None = None, level: int = logging.INFO) -> None:
    """Set structlog up once, to stderr; `json_lines` None: JSON unless stderr is a terminal."""
    as_json = not sys.stderr.isatty() if json_lines is None else json_lines
    renderer: structlog.typing.Processor = (
        structlog.processors.JSONRenderer() if as_json else structlog.dev.ConsoleRenderer(colors=sys.stderr.isatty())
    )
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=structlog.PrintLoggerFactory(sys.stderr),
        cache_logger_on_first_use=False,
    )


def set_level(level: str) -> None:
    """Let through what is as grave as `level` (debug, info, warning, error) or graver."""
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()])
    )


class OncePerSecond:
    """Lets one message of each kind through per second; says how many were held back."""

    def __init__(self) -> None:
        self._until_s: dict[str, float] = {}
        self._held: dict[str, int] = {}

    def admit(self, kind: str, now_s: float) -> int | None:
        """None: hold it back. Else how many of its kind were held back since the last one let through."""
        if now_s < self._until_s.get(kind, -1e300):
            self._held[kind] = self._held.get(kind, 0) + 1
            return None
        self._until_s[kind] = now_s + 1.0
        return self._held.pop(kind, 0)
