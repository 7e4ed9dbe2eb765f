"""Progress bars on standard error, output folders, and questions on standard input while an event loop runs."""

from __future__ import annotations

import asyncio
import os
import sys
import termios
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Protocol

from slipguard.errors import InputError


class ProgressCallback(Protocol):
    """Updates a bar: the amount done, the total if it was not known before, and the present step."""

    def __call__(self, done: float, total: float | None = None, step: str | None = None, /) -> None: ...


@contextmanager
def progress_bars() -> Iterator[Callable[[str, float | None], ProgressCallback]]:
    """Show bars on a terminal; the callback adds one with a description and the total, None if not yet known."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    if not console.is_terminal:
        yield lambda description, total: lambda done, new_total=None, step=None: None
        return
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=console, transient=True) as bars:

        def add(description: str, total: float | None) -> ProgressCallback:
            task = bars.add_task(description, total=total)
            return lambda done, new_total=None, step=None: bars.update(
                task, completed=done, total=new_total, description=step
            )

        yield add


@contextmanager
def progress_bar(description: str) -> Iterator[Callable[[str, float], None]]:
    """Show a bar on a terminal; the callback takes the present step and the completed share, 0 to 1."""
    with progress_bars() as add:
        update = add(description, 1.0)
        yield lambda step, share: update(share, None, step)


@contextmanager
def count_bar(description: str, total: int | None = None) -> Iterator[ProgressCallback]:
    """Show a bar on a terminal; the callback takes the number of completed items, and the total if not given here."""
    with progress_bars() as add:
        yield add(description, total)


def make_folder(path: Path | None, option: str = "--out") -> None:
    """Create the folder of an option, if one is given. Raises InputError."""
    if path is None:
        return
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{option} {path}: cannot create the folder: {error.strerror}. Choose another one") from error


async def ask(text: str, word: str) -> bool:
    """Wait until the user types `word`, or presses Enter if it is ""; return False for q or the end of the input.

    Input from before the question is discarded. Can be cancelled at any time.
    """
    wanted = f"type {word} and Enter" if word else "Enter"
    while True:
        print(f"{text} [{wanted}, or q to stop] ", end="", flush=True)
        if sys.stdin.isatty():
            termios.tcflush(sys.stdin, termios.TCIFLUSH)
        line = await _read_line(sys.stdin.fileno())
        if line is None or line.strip().lower().startswith("q"):
            return False
        if line.strip().lower() == word:
            return True


async def _read_line(descriptor: int) -> str | None:
    """Return the next line, None at the end of the input. Does not use a thread, which Ctrl-C could not interrupt."""
    loop = asyncio.get_running_loop()
    result: asyncio.Future[str | None] = loop.create_future()
    received = bytearray()

    def on_readable() -> None:
        if result.done():
            return  # the rest belongs to the next question
        byte = os.read(descriptor, 1)
        if byte not in (b"", b"\n"):
            received.extend(byte)
        else:
            result.set_result(received.decode(errors="replace") if byte or received else None)

    try:
        loop.add_reader(descriptor, on_readable)
    except PermissionError:  # a file or /dev/null, which never blocks
        while not result.done():
            on_readable()
        return await result
    try:
        return await result
    except asyncio.CancelledError:
        print()  # the next output starts on a new line
        raise
    finally:
        loop.remove_reader(descriptor)
