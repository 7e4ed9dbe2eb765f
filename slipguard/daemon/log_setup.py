"""Set up the log: entries of the journal under systemd, colored text on a terminal, else JSON lines."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable
from typing import Any, TextIO

import structlog

from slipguard.daemon.journal import JournalOutput, render_entry, stderr_is_journal


def configure(*, json_lines: bool | None = None, level: int = logging.INFO) -> None:
    """Set up structlog. json_lines: JSON or text on stderr; None for what suits where stderr leads to."""
    renderer: structlog.typing.Processor
    write: Callable[[Any], object]
    if json_lines is None and stderr_is_journal():
        renderer, write = render_entry, JournalOutput().write
    elif json_lines is False or (json_lines is None and sys.stderr.isatty()):
        renderer = structlog.dev.ConsoleRenderer(
            colors=sys.stderr.isatty(),
            exception_formatter=structlog.dev.plain_traceback,  # the rich one prints local variables, even the token
        )
        write = _StreamOutput(sys.stderr).write
    else:
        renderer, write = structlog.processors.JSONRenderer(), _StreamOutput(sys.stderr).write
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=lambda *names: _Logger(write),
        cache_logger_on_first_use=False,
    )


def set_level(level: str) -> None:
    """Log only messages of this level (debug, info, warning, error) or above."""
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()])
    )


class _Logger:
    """What structlog calls with each finished entry. write: receives the entry."""

    def __init__(self, write: Callable[[Any], object]) -> None:
        self.debug = self.info = self.warning = self.error = self.critical = write


class _StreamOutput:
    """Writes lines to a stream; ignores failures, such as a closed terminal or a full disk."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def write(self, line: str) -> None:
        """Write one line if possible."""
        with contextlib.suppress(OSError, ValueError):
            self._stream.write(f"{line}\n")
            self._stream.flush()
