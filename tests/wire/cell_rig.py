"""An emulated cell and the daemon that guards it, each a process of its own, as a user starts them."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from slipguard.daemon.api.client import Client
from slipguard.errors import CommandRefused, SlipguardError

PATIENCE_S = 40.0
PATIENT_GUARD = """watchdog_hz = 2
[guard.tuning]
frames_timeout_s = 1.5
gripper_timeout_s = 2
arm_timeout_s = 2
cycle_timeout_s = 2
tighten_effect_timeout_s = 4
"""
pause = threading.Event().wait


class Process:
    """`slipguard WORDS...` with its output in a file."""

    def __init__(self, folder: Path, name: str, *words: object) -> None:
        self.output = folder / f"{name}.txt"
        with self.output.open("w") as out:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "slipguard", *(str(word) for word in words)],
                stdin=subprocess.PIPE,
                stdout=out,
                stderr=subprocess.STDOUT,
                text=True,
                env={**os.environ, "HOME": str(folder), "OMP_NUM_THREADS": "1", "COLUMNS": "200"},
            )

    @property
    def said(self) -> str:
        """All it has printed."""
        return self.output.read_text()

    def send(self, line: str) -> None:
        """A line to its stdin."""
        assert self._process.stdin is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()

    def stop(self) -> int:
        """SIGTERM, and its exit code; one that does not end is killed."""
        self._process.send_signal(signal.SIGTERM)
        try:
            return self._process.wait(PATIENCE_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            raise
        finally:
            assert self._process.stdin is not None
            self._process.stdin.close()

    def kill(self) -> None:
        """SIGKILL, any it does."""
        self._process.kill()
        self._process.wait()
        assert self._process.stdin is not None
        self._process.stdin.close()

    @property
    def running(self) -> bool:
        """Whether it still does."""
        return self._process.poll() is None

    @property
    def cpu_s(self) -> float:
        """Its own work so far, in user and system mode."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


class Cell:
    """The double of a cell. folder: its configuration, sockets and log."""

    def __init__(self, folder: Path, process: Process) -> None:
        self.folder = folder
        self.process = process

    @property
    def config(self) -> Path:
        """For `slipguard run`."""
        return self.folder / "config.toml"

    def truth(self) -> list[dict[str, Any]]:
        """What really happened, oldest first."""
        lines = (self.folder / "truth.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines if line.endswith("}")]

    def order(self, line: str) -> str:
        """Send a control line, and return the answer."""
        before = self.process.said.count('"answer"')
        self.process.send(line)
        until(
            lambda: self.process.said.count('"answer"') > before, f"{line!r} is not obeyed", lambda: self.process.said
        )
        answers = [line for line in self.process.said.splitlines() if line.startswith("{") and '"answer"' in line]
        return str(json.loads(answers[-1])["answer"])

    def events(self, name: str) -> list[dict[str, Any]]:
        """The events that the doubles reported."""
        lines = [json.loads(line) for line in self.process.said.splitlines() if line.startswith("{")]
        return [line for line in lines if line.get("event") == name]


@contextmanager
def cell(folder: Path, host: str, *options: object, activated: bool = True) -> Iterator[Cell]:
    """A cell that is ready, with the gripper activated or not; ended at the end."""
    place = folder / "cell"
    gripper = ["--activated"] if activated else []
    words = ("emulate", "cell", "--json", "--folder", place, "--host", host, *gripper, "--robot-on", *options)
    process = Process(folder, "emulate", *words)
    try:
        until(lambda: '"ready"' in process.said, "the cell is not ready", lambda: process.said)
        yield Cell(place, process)
    finally:
        assert process.stop() == 0, process.said


def patient_config(cell: Cell, guard: str = PATIENT_GUARD, stall_ms: int = 1000) -> Path:
    """The cell's configuration, for a machine that runs other tests as well."""
    patient = cell.folder / "patient.toml"
    text = cell.config.read_text().replace("[guard]\n", f"{guard}[guard]\n")
    patient.write_text(text.replace('.sock"\n', f'.sock"\nstall_ms = {stall_ms}\n', 2))
    return patient


@contextmanager
def daemon(cell: Cell) -> Iterator[Client]:
    """The daemon of a cell, all its devices ready; ended at the end.

    It waits longer for everything than on a real cell: a busy machine that runs tests is no fault of a device.
    """
    process = Process(cell.folder, "run", "run", "--config", patient_config(cell), "--log-json")
    try:
        with Client(cell.folder / "slipguard.sock") as client:
            wait_for(client, lambda state: not state["waiting_for"], "the devices are not ready")
            yield client
    finally:
        code = process.stop()
        assert "Traceback" not in process.said, process.said
        assert code == 0, process.said


def patiently(command: Callable[[], object]) -> None:
    """Give a command until it is not refused: a device may just have been late."""
    why: list[str] = []

    def done() -> bool:
        try:
            command()
        except CommandRefused as refusal:
            why.append(str(refusal))
            return False
        return True

    until(done, "refused", lambda: why[-1])


def wait_for(client: Client, good: Callable[[dict[str, Any]], object], otherwise: str) -> dict[str, Any]:
    """The first state that is as it should be; a fault of the guard fails at once."""
    newest: dict[str, Any] = {}

    def reached() -> object:
        nonlocal newest
        try:
            newest = client.state()
        except SlipguardError:
            return False
        assert newest["fault"] is None, newest["fault"]
        return good(newest)

    until(reached, otherwise, lambda: {key: newest.get(key) for key in ("phase", "waiting_for", "events")})
    return newest


def until(
    reached: Callable[[], object],
    otherwise: str,
    what: Callable[[], object],
    *,
    every_s: float = 0.05,
    within_s: float = PATIENCE_S,
) -> None:
    """Wait for a condition."""
    ends_s = time.monotonic() + within_s
    while not reached():
        assert time.monotonic() < ends_s, f"{otherwise}: {what()}"
        pause(every_s)
