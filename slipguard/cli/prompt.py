"""A question at the terminal, beside a running event loop."""

from __future__ import annotations

import asyncio
import os
import sys
import termios


async def ask(text: str, word: str) -> bool:
    """Wait for `word`, or for Enter alone where it is ""; a line that begins with q, or no more input, is a no.

    What was typed before the question does not answer it. Ends at once when cancelled.
    """
    wanted = f"type {word} and Enter" if word else "Enter"
    while True:
        print(f"{text} [{wanted}, or q to stop] ", end="", flush=True)
        if sys.stdin.isatty():
            termios.tcflush(sys.stdin, termios.TCIFLUSH)
        line = await _line(sys.stdin.fileno())
        if line is None or line.strip().lower().startswith("q"):
            return False
        if line.strip().lower() == word:
            return True


async def _line(descriptor: int) -> str | None:
    """The next line, None at the end of the input; no thread waits for it, so a Ctrl-C has nothing to wait for."""
    loop = asyncio.get_running_loop()
    got: asyncio.Future[str | None] = loop.create_future()
    read = bytearray()

    def readable() -> None:
        if got.done():
            return  # what follows belongs to the next question
        one = os.read(descriptor, 1)
        if one not in (b"", b"\n"):
            read.extend(one)
        else:
            got.set_result(read.decode(errors="replace") if one or read else None)

    try:
        loop.add_reader(descriptor, readable)
    except PermissionError:  # a file or /dev/null, which never keeps anybody waiting
        while not got.done():
            readable()
        return await got
    try:
        return await got
    except asyncio.CancelledError:
        print()  # what is said next begins a line
        raise
    finally:
        loop.remove_reader(descriptor)
