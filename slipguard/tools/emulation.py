"""Runs one emulator for a person or a program: commands in, events out, one line each."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import threading
from collections.abc import Callable, Mapping

from slipguard.emulator import Emulator, Event, Report
from slipguard.errors import CommandRefused, InputError

STDIN = 0


async def run(name: str, build: Callable[[Report], Emulator], faults: list[str], *, json_lines: bool) -> None:
    """Emulate until SIGINT, SIGTERM or `quit`.

    Args:
        faults: NAME, NAME:PROBABILITY or NAME:COUNT.
        json_lines: Print {"ready": address}, events, {"state"}, {"answer"} or {"refused"} instead of plain text.

    Raises:
        InputError: for an unknown fault, and as `Emulator.start`.
    """

    def show(text: str, message: Mapping[str, object]) -> None:
        print(json.dumps(dict(message)) if json_lines else text, flush=True)

    emulator = build(lambda event: show(_event_line(event), event))
    for fault in faults:
        try:
            emulator.control(f"fault {fault.replace(':', ' ')}")
        except CommandRefused as refusal:
            raise InputError(f"--fault {fault}: {refusal}") from None
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)

    def execute(line: str) -> None:
        if line == "quit":
            ended.set()
            return
        try:
            if line == "state":
                state = dict(emulator.state())
                show("\n".join(f"{key}: {value}" for key, value in state.items()), {"state": state})
            else:
                answer = emulator.control(line)
                show(answer, {"answer": answer})
        except CommandRefused as refusal:
            show(f"refused: {refusal}", {"refused": str(refusal)})

    try:
        await emulator.start()
        show(f"{name} emulated at {emulator.address}", {"ready": emulator.address, "emulator": name})
        threading.Thread(target=_read_lines, args=(loop, execute), name="commands", daemon=True).start()
        await ended.wait()
    finally:
        await emulator.stop()


def _read_lines(loop: asyncio.AbstractEventLoop, execute: Callable[[str], None]) -> None:
    """Pass on lines of stdin until it ends. Plain reads: a thread inside `sys.stdin` would delay the exit."""
    pending = b""
    try:
        while piece := os.read(STDIN, 4096):
            *lines, pending = (pending + piece).split(b"\n")
            for line in lines:
                if text := line.decode(errors="replace").strip():
                    loop.call_soon_threadsafe(execute, text)
    except (OSError, RuntimeError):  # stdin is closed, or the loop has ended
        return


def _event_line(event: Event) -> str:
    at_s, name = event.get("at_s", ""), event.get("event", "")
    details = ", ".join(f"{key} {value}" for key, value in event.items() if key not in ("at_s", "event"))
    return f"{at_s}  {name}" + (f": {details}" if details else "")
