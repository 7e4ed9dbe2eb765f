"""Runs one emulator for a person or a program: commands in, events out."""

from __future__ import annotations

import asyncio
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Mapping

from slipguard.emulator import Emulator, Event, Report
from slipguard.errors import CommandRefused, InputError

REFRESH_S = 0.25
"""How often the table is drawn, if something has changed."""
STDIN = 0


async def run(name: str, build: Callable[[Report], Emulator], faults: list[str], *, json_lines: bool) -> None:
    """Emulate until SIGINT, SIGTERM or `quit`.

    Args:
        faults: NAME, NAME:PROBABILITY or NAME:COUNT.

    Raises:
        InputError: for an unknown fault, and as `Emulator.start`.
    """
    output: PlainOutput = (
        JsonOutput(name) if json_lines else TableOutput(name) if sys.stdout.isatty() else PlainOutput(name)
    )
    emulator = build(output.event)
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
                output.state(emulator.state())
            else:
                output.response(emulator.control(line), refused=False)
        except CommandRefused as refusal:
            output.response(str(refusal), refused=True)

    try:
        await emulator.start()
        output.ready(emulator.address)
        threading.Thread(target=_read_lines, args=(loop, execute), name="commands", daemon=True).start()
        while not ended.is_set():
            output.refresh(emulator.state())
            try:
                async with asyncio.timeout(REFRESH_S):
                    await ended.wait()
            except TimeoutError:
                continue
    finally:
        output.close()
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


class PlainOutput:
    """Prints plain lines: the address, then events and responses."""

    def __init__(self, name: str) -> None:
        self.name = name

    def ready(self, address: str) -> None:
        print(f"{self.name} emulated at {address}", flush=True)

    def event(self, event: Event) -> None:
        print(_event_line(event), flush=True)

    def response(self, text: str, *, refused: bool) -> None:
        print(f"refused: {text}" if refused else text, flush=True)

    def state(self, state: Mapping[str, object]) -> None:
        self.response("\n".join(f"{key}: {value}" for key, value in state.items()), refused=False)

    def refresh(self, state: Mapping[str, object]) -> None:
        """Show the present state; called several times per second."""
        return

    def close(self) -> None:
        return


class JsonOutput(PlainOutput):
    """Prints one JSON object per line: {"ready": address}, events, {"state"}, {"answer"} or {"refused"}."""

    def ready(self, address: str) -> None:
        print(json.dumps({"ready": address, "emulator": self.name}), flush=True)

    def event(self, event: Event) -> None:
        print(json.dumps(dict(event)), flush=True)

    def response(self, text: str, *, refused: bool) -> None:
        print(json.dumps({"refused" if refused else "answer": text}), flush=True)

    def state(self, state: Mapping[str, object]) -> None:
        print(json.dumps({"state": dict(state)}), flush=True)


class TableOutput(PlainOutput):
    """Shows a table of the state, drawn when it changes, and the newest lines below it."""

    LINES = 8

    def __init__(self, name: str) -> None:
        super().__init__(name)
        from rich.live import Live

        self._lines: list[str] = []
        self._drawn: object = None
        self._live = Live(auto_refresh=False)
        self._address = ""

    def ready(self, address: str) -> None:
        self._address = address
        self._live.start()

    def event(self, event: Event) -> None:
        self._add(_event_line(event))

    def response(self, text: str, *, refused: bool) -> None:
        for line in (f"refused: {text}" if refused else text).splitlines():
            self._add(line)

    def refresh(self, state: Mapping[str, object]) -> None:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        current = (dict(state), tuple(self._lines))
        if current == self._drawn:
            return  # do not overwrite the line that is being typed
        self._drawn = current
        table = Table(title=f"{self.name} at {self._address}", show_header=False)
        for key, value in state.items():
            table.add_row(key, str(value))
        hint = Text("fault NAME [probability|count], clear, state, log, help, quit", style="dim")
        self._live.update(Group(table, *(Text(line) for line in self._lines), hint), refresh=True)

    def close(self) -> None:
        self._live.stop()

    def _add(self, line: str) -> None:
        self._lines = [*self._lines, line][-self.LINES :]


def _event_line(event: Event) -> str:
    at_s, name = event.get("at_s", ""), event.get("event", "")
    details = ", ".join(f"{key} {value}" for key, value in event.items() if key not in ("at_s", "event"))
    return f"{at_s}  {name}" + (f": {details}" if details else "")
