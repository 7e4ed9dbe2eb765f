"""Runs one emulator for a person or a program: control words in, what really happens out."""

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
"""The table is drawn anew this often, where something has changed."""
STDIN = 0


async def run(name: str, build: Callable[[Report], Emulator], faults: list[str], *, json_lines: bool) -> None:
    """Emulate until SIGINT, SIGTERM or `quit`. faults: NAME, NAME:PROBABILITY or NAME:COUNT.

    Raises InputError for a fault there is not, and what `start` raises.
    """
    screen: Screen = JsonLines(name) if json_lines else Terminal(name) if sys.stdout.isatty() else Plain(name)
    emulator = build(screen.event)
    for fault in faults:
        try:
            emulator.control(f"fault {fault.replace(':', ' ')}")
        except CommandRefused as refusal:
            raise InputError(f"--fault {fault}: {refusal}") from None
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    for number in (signal.SIGINT, signal.SIGTERM):
        loop.add_signal_handler(number, ended.set)

    def heed(line: str) -> None:
        if line == "quit":
            ended.set()
            return
        try:
            if line == "state":
                screen.told_state(emulator.state())
            else:
                screen.answer(emulator.control(line), refused=False)
        except CommandRefused as refusal:
            screen.answer(str(refusal), refused=True)

    try:
        await emulator.start()
        screen.ready(emulator.address)
        threading.Thread(target=_read_lines, args=(loop, heed), name="control words", daemon=True).start()
        while not ended.is_set():
            screen.show(emulator.state())
            try:
                async with asyncio.timeout(REFRESH_S):
                    await ended.wait()
            except TimeoutError:
                continue
    finally:
        screen.close()
        await emulator.stop()


def _read_lines(loop: asyncio.AbstractEventLoop, heed: Callable[[str], None]) -> None:
    """Hand on lines of stdin until it ends. Plain reads: a thread inside `sys.stdin` would hold up the exit."""
    pending = b""
    try:
        while piece := os.read(STDIN, 4096):
            *lines, pending = (pending + piece).split(b"\n")
            for line in lines:
                if text := line.decode(errors="replace").strip():
                    loop.call_soon_threadsafe(heed, text)
    except (OSError, RuntimeError):  # no stdin at all, or the loop has ended
        return


class Screen:
    """Where it is told. Plain lines: the address, then events and answers."""

    def __init__(self, name: str) -> None:
        self.name = name

    def ready(self, address: str) -> None:
        """It can be reached now."""
        print(f"{self.name} emulated at {address}", flush=True)

    def event(self, event: Event) -> None:
        """Something has happened."""
        print(_sentence(event), flush=True)

    def answer(self, text: str, *, refused: bool) -> None:
        """A control word was obeyed, or not."""
        print(f"refused: {text}" if refused else text, flush=True)

    def told_state(self, state: Mapping[str, object]) -> None:
        """The state, because it was asked for."""
        self.answer("\n".join(f"{key}: {value}" for key, value in state.items()), refused=False)

    def show(self, state: Mapping[str, object]) -> None:
        """The present state; offered a few times a second."""
        return

    def close(self) -> None:
        """It ends."""
        return


Plain = Screen


class JsonLines(Screen):
    """One JSON object a line: {"ready": address}, events as they are, {"state"}, {"answer"} or {"refused"}."""

    def ready(self, address: str) -> None:
        print(json.dumps({"ready": address, "emulator": self.name}), flush=True)

    def event(self, event: Event) -> None:
        print(json.dumps(dict(event)), flush=True)

    def answer(self, text: str, *, refused: bool) -> None:
        print(json.dumps({"refused" if refused else "answer": text}), flush=True)

    def told_state(self, state: Mapping[str, object]) -> None:
        print(json.dumps({"state": dict(state)}), flush=True)


class Terminal(Screen):
    """A table of the state, drawn anew where it has changed; the newest lines below it."""

    LINES = 8

    def __init__(self, name: str) -> None:
        super().__init__(name)
        from rich.live import Live

        self._lines: list[str] = []
        self._drawn: object = None
        self._state: Mapping[str, object] = {}
        self._live = Live(auto_refresh=False)
        self._address = ""

    def ready(self, address: str) -> None:
        self._address = address
        self._live.start()

    def event(self, event: Event) -> None:
        self._add(_sentence(event))

    def answer(self, text: str, *, refused: bool) -> None:
        for line in (f"refused: {text}" if refused else text).splitlines():
            self._add(line)

    def show(self, state: Mapping[str, object]) -> None:
        from rich.console import Group
        from rich.table import Table
        from rich.text import Text

        wanted = (dict(state), tuple(self._lines))
        if wanted == self._drawn:
            return  # leave the line that is being typed alone
        self._drawn = wanted
        table = Table(title=f"{self.name} at {self._address}", show_header=False)
        for key, value in state.items():
            table.add_row(key, str(value))
        hint = Text("fault NAME [probability|count], clear, state, log, help, quit", style="dim")
        self._live.update(Group(table, *(Text(line) for line in self._lines), hint), refresh=True)

    def close(self) -> None:
        self._live.stop()

    def _add(self, line: str) -> None:
        self._lines = [*self._lines, line][-self.LINES :]


def _sentence(event: Event) -> str:
    at_s, word = event.get("at_s", ""), event.get("event", "")
    rest = ", ".join(f"{key} {value}" for key, value in event.items() if key not in ("at_s", "event"))
    return f"{at_s}  {word}" + (f": {rest}" if rest else "")
