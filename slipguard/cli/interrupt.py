"""Ctrl-C at any time: one line, exit code 1, no traceback."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from types import FrameType

INTERRUPTED = "slipguard: interrupted"
IMPORTER = "<frozen importlib._bootstrap>"


class InterruptHandler:
    """The handler of SIGINT. interrupted: whether one came, even if a library has replaced the KeyboardInterrupt."""

    def __init__(self) -> None:
        self.interrupted = False

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """Raise KeyboardInterrupt; while a module is being imported, exit at once.

        During an import no file or device is open, and extension modules turn the exception into other errors.
        """
        self.interrupted = True
        while frame is not None:
            if frame.f_code.co_filename == IMPORTER:
                os.write(2, f"{INTERRUPTED}\n".encode())
                os._exit(1)
            frame = frame.f_back
        raise KeyboardInterrupt


@contextmanager
def default_interrupts() -> Iterator[None]:
    """Use Python's own SIGINT handler: only then does asyncio turn a Ctrl-C into a cancelled main task."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
