"""Ctrl-C at any moment: one line, exit code 1, no traceback."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

SAID = "slipguard: interrupted"
IMPORTER = "<frozen importlib._bootstrap>"


class Interrupt:
    """The handler of SIGINT. noticed: whether one came, whatever a library made of the KeyboardInterrupt."""

    def __init__(self) -> None:
        self.noticed = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt; end at once where a module is being imported.

        Nothing is open then, and extension modules answer the exception with tracebacks and errors of their own.
        """
        self.noticed = True
        while frame is not None:
            if frame.f_code.co_filename == IMPORTER:
                os.write(2, f"{SAID}\n".encode())
                os._exit(1)
            frame = frame.f_back
        raise KeyboardInterrupt


@contextmanager
def default_interrupts() -> Iterator[None]:
    """asyncio turns a Ctrl-C into a cancelled main task, but only where nobody else has put a handler."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
