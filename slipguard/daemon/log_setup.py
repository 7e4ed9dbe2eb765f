"""Set up the log: entries of the journal under systemd, colored text on a terminal, else JSON lines."""

from __future__ import annotations

import atexit
import logging
import sys
from collections.abc import Callable
from typing import Any

import structlog

from slipguard.daemon.journal import JournalOutput, render_entry, stderr_is_journal
from slipguard.daemon.log_queue import LogQueue, StreamOutput

log = structlog.get_logger()
_queue: LogQueue[Any] | None = None


def configure(*, json_lines: bool | None = None, level: int = logging.INFO) -> None:
    """Set up structlog. json_lines: JSON or text on stderr; None for what suits where stderr leads to."""
    global _queue
    on_terminal = sys.stderr is not None and sys.stderr.isatty()
    renderer: structlog.typing.Processor
    output: JournalOutput | StreamOutput
    if _queue is not None:
        _queue.close()
    if json_lines is None and stderr_is_journal():
        renderer, output = render_entry, JournalOutput()
    elif json_lines is False or (json_lines is None and on_terminal):
        renderer = structlog.dev.ConsoleRenderer(
            colors=on_terminal,
            exception_formatter=structlog.dev.plain_traceback,  # the rich one prints local variables, even the token
        )
        output = StreamOutput(sys.stderr)
    else:
        renderer, output = structlog.processors.JSONRenderer(), StreamOutput(sys.stderr)
    _queue = queue = LogQueue[Any](output.write, _report_lost)
    structlog.configure(
        processors=[
            structlog.processors.add_log_level,
            structlog.processors.TimeStamper(fmt="iso", utc=True),
            structlog.processors.format_exc_info,
            renderer,
        ],
        wrapper_class=structlog.make_filtering_bound_logger(level),
        logger_factory=lambda *names: _Logger(queue.put),
        cache_logger_on_first_use=False,
    )
    logging.lastResort = _LibraryHandler(logging.WARNING)  # Python's own writes to stderr in the calling thread


def set_level(level: str) -> None:
    """Log only messages of this level (debug, info, warning, error) or above."""
    structlog.configure(
        wrapper_class=structlog.make_filtering_bound_logger(logging.getLevelNamesMapping()[level.upper()])
    )


@atexit.register
def flush(timeout_s: float = 1.0) -> bool:
    """Wait until all entries are written, for at most `timeout_s`; return whether they are."""
    return _queue is None or _queue.flush(timeout_s)


def lost_lines() -> int:
    """Return how many entries were lost since the start, because the output was blocked."""
    return 0 if _queue is None else _queue.lost


def _report_lost(lines: int, blocked_s: float) -> None:
    log.warning(
        f"the log was blocked for {blocked_s:.0f} s: {lines} lines are lost since the start; "
        "check the terminal or journal"
    )


class _Logger:
    """What structlog calls with each finished entry. write: receives the entry."""

    def __init__(self, write: Callable[[Any], object]) -> None:
        self.debug = self.info = self.warning = self.error = self.critical = write


class _LibraryHandler(logging.Handler):
    """Passes messages of libraries, such as asyncio, to the queue."""

    def emit(self, record: logging.LogRecord) -> None:
        values: dict[str, Any] = {"logger": record.name}
        if record.exc_info:
            values["exc_info"] = record.exc_info
        log.log(record.levelno, record.getMessage(), **values)
