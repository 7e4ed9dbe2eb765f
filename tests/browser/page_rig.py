"""A simulated cell in a process of its own, for the page's tests, and commands to control it."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, ReleaseRequest
from slipguard.errors import CommandRefused, SlipguardError

TIMEOUT_S = 90.0
CONFIG = """
[left]
driver = "fake"
[right]
driver = "fake"
[gripper]
driver = "fake"
[arm]
driver = "fake"
[state]
directory = "{folder}/state"
[api]
socket = "{folder}/s.sock"
listen = "127.0.0.1:{port}"
[recording]
enabled = false
[guard]
lift_height_mm = 40
release_width_mm = 40
lift_speed_mm_s = 100
[guard.tuning]
lower_speed_mm_s = 100
frames_timeout_s = 5
estimate_timeout_s = 10
lost_after_s = 2
gripper_timeout_s = 5
arm_timeout_s = 5
stuck_timeout_s = 10
cycle_timeout_s = 5
tighten_effect_timeout_s = 10
"""
"""A short lift, and longer timeouts than on a real cell, because the test machine may be busy."""
pause = Event().wait


class DaemonProcess:
    """A daemon's process, and a client on its Unix socket. url: of the page."""

    def __init__(self, folder: Path) -> None:
        self._port = free_port()
        self.url = f"http://127.0.0.1:{self._port}/"
        self._output = folder / "daemon.txt"
        config = folder / "config.toml"
        config.write_text(CONFIG.format(folder=folder, port=self._port))
        self.client = Client(folder / "s.sock")
        with self._output.open("w") as log:
            self._process = subprocess.Popen(
                [sys.executable, Path(__file__).parent / "daemon_process.py", config],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=log,
                text=True,
                env={**os.environ, "HOME": str(folder), "OMP_NUM_THREADS": "1"},
            )

    @property
    def log(self) -> str:
        """Return its log."""
        return self._output.read_text()

    def order(self, line: str) -> None:
        """Send a command to `daemon_process` and wait until it is executed."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(line + "\n")
        self._process.stdin.flush()
        while (response := self._process.stdout.readline()) not in ("done\n", ""):
            pass
        assert response, self.log

    def state(self) -> dict[str, Any]:
        """Return the daemon's state; empty while it does not respond."""
        try:
            return self.client.state()
        except SlipguardError:
            return {}

    def until(self, reached: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Wait for a state, and return it."""
        ends_s = time.monotonic() + TIMEOUT_S
        while True:
            state = self.state()
            if state and reached(state):
                return state
            assert time.monotonic() < ends_s, f"{state.get('phase')} {state.get('waiting_for')}\n{self.log[-3000:]}"
            assert self._process.poll() is None, self.log
            pause(0.05)

    def well(self) -> dict[str, Any]:
        """End all device faults; return the state."""
        self.order("mend")
        return self.until(lambda state: not state["waiting_for"])

    def fresh(self) -> None:
        """Reset: no faults, nothing held, an object between the open jaws."""
        self.well()
        self.client.submit(ReleaseRequest(confirm=True))
        self.until(lambda state: state["phase"] == "idle" and not state["gripper"]["moving"])
        self.order("fresh")
        self.until(lambda state: not state["waiting_for"])

    def held(self, again: bool = True) -> None:
        """Grip the object, with both fingers' background images known; again: even if it is gripped already."""
        if not again:
            state = self.well()
            if state["phase"] == "holding" and state["guarding"]:
                return
        self.fresh()
        try:
            self.client.submit(GraspRequest())
        except CommandRefused:  # it knows no no-contact images yet
            self.client.submit(CalibrateRequest())
            self.client.submit(GraspRequest())
        self.until(lambda state: state["phase"] == "holding" and not state["gripper"]["moving"])

    @contextmanager
    def frozen(self) -> Iterator[None]:
        """Suspend the process during the block."""
        self._process.send_signal(signal.SIGSTOP)
        try:
            yield
        finally:
            self._process.send_signal(signal.SIGCONT)

    def stop(self) -> None:
        """Stop the process with SIGTERM, and check its exit code."""
        self.client.close()
        self._process.send_signal(signal.SIGTERM)
        try:
            assert self._process.wait(TIMEOUT_S) == 0, self.log
            assert "Traceback" not in self.log, self.log
        finally:
            self._process.kill()
            self._process.wait()
            for pipe in (self._process.stdin, self._process.stdout):
                assert pipe is not None
                pipe.close()


@contextmanager
def daemon(folder: Path) -> Iterator[DaemonProcess]:
    """Provide a daemon with all devices ready."""
    made = DaemonProcess(folder)
    try:
        made.until(lambda state: not state["waiting_for"])
        yield made
    finally:
        made.stop()


def free_port() -> int:
    """Return a TCP port that is free."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
