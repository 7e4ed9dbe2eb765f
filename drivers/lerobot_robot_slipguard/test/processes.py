"""slipguard's daemon as a process, on an emulated cell or with devices that cost nothing."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from lerobot_camera_slipguard import DaemonUnreachable, LocalApi, RequestRefused

LIGHT_DAEMON = Path(__file__).resolve().parents[3] / "tests" / "wire" / "light_daemon.py"
START_TIMEOUT_S = 90.0
OPEN_MM = 60.0
EMULATE = (
    *("emulate", "cell", "--object", "wrench", "--seed", "0", "--fps", "30", "--mode", "guard"),
    *("--height-mm", "20", "--play-again-s", "0.5", "--activated", "--robot-on"),
)
PATIENT_GUARD = """watchdog_hz = 2
[guard.tuning]  # for a busy machine
frames_timeout_s = 5
gripper_timeout_s = 5
arm_timeout_s = 5
cycle_timeout_s = 5
tighten_effect_timeout_s = 8
"""


def wait_until(reached: Callable[[], Any], what: str, within_s: float = 30.0) -> Any:
    """Wait until `reached` returns a true value, and return it. Raises AssertionError."""
    ends_s = time.monotonic() + within_s
    while not (value := reached()):
        assert time.monotonic() < ends_s, f"not within {within_s:g} s: {what}"
        time.sleep(0.02)
    return value


class Daemon:
    """A daemon in guard mode whose simulated devices cost nothing, so that a busy machine does not matter.

    python: the interpreter of slipguard's environment.
    """

    def __init__(self, python: str, folder: Path) -> None:
        self._python, self.folder = python, folder
        self.socket = str(folder / "slipguard.sock")
        self._processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Daemon:
        self.folder.mkdir(exist_ok=True)
        self.api = LocalApi(self.socket)
        try:
            self._start_all()
            wait_until(self._is_ready, "the daemon is ready", START_TIMEOUT_S)
            wait_until(self._calibrate, "calibrated", START_TIMEOUT_S)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self.api.close()
        for process in reversed(self._processes):
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def state(self) -> dict[str, Any]:
        """Return the daemon's state."""
        return self.api.state()

    def wait_for(self, *phases: str) -> dict[str, Any]:
        """Wait for one of the phases; return the state."""

        def reached() -> dict[str, Any] | None:
            state = self.state()
            return state if state["phase"] in phases else None

        return dict(wait_until(reached, f"phase {' or '.join(phases)}"))

    def release(self) -> None:
        """Open the jaws; then the next object lies between them."""
        state = self.state()
        if state["phase"] != "idle" or state["gripper"]["width_mm"] < OPEN_MM:
            self.api.submit("release", {"confirm": True})
            wait_until(lambda: self.state()["phase"] == "idle", "released")
            wait_until(lambda: self.state()["gripper"]["width_mm"] > OPEN_MM, "the jaws are open")
        self._place()

    def _place(self) -> None:
        time.sleep(0.5)  # the simulation does it

    def _start_all(self) -> None:
        self._start("daemon", str(LIGHT_DAEMON), str(self.folder), str(self.folder / "state"), "guard-mode")

    def _calibrate(self) -> bool:
        with contextlib.suppress(RequestRefused):  # a busy machine may be late with a frame
            return bool(self.api.submit("calibrate", {}, 40.0))
        return False

    def _is_ready(self) -> bool:
        assert self._processes[-1].poll() is None, (self.folder / "daemon.txt").read_text()
        with contextlib.suppress(DaemonUnreachable, RequestRefused):
            return not self.state()["waiting_for"]
        return False

    def _start(self, name: str, *words: str) -> None:
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        with (self.folder / f"{name}.txt").open("w") as out:
            self._processes.append(
                subprocess.Popen(
                    [self._python, *words],
                    stdin=subprocess.PIPE,
                    stdout=out,
                    stderr=out,
                    text=True,
                    env=environment | {"HOME": str(self.folder), "OMP_NUM_THREADS": "1"},
                )
            )


class EmulatedCell(Daemon):
    """`slipguard emulate cell` and the daemon, as a user starts them: its robot lifts what the gripper holds."""

    def order(self, line: str) -> None:
        """Write a line to the emulator, such as `fault left.stall`."""
        stdin = self._processes[0].stdin
        assert stdin is not None
        stdin.write(line + "\n")
        stdin.flush()

    def _place(self) -> None:
        self.order("place wrench 0")

    def _start_all(self) -> None:
        host = f"127.{20 + os.getpid() // 256 % 200}.{os.getpid() % 256}.80"  # the ports of a robot cannot be chosen
        self._start("emulate", "-m", "slipguard", *EMULATE, "--folder", str(self.folder), "--host", host)
        config, patient = self.folder / "config.toml", self.folder / "patient.toml"
        wait_until(lambda: config.exists() and "[state]" in config.read_text(), "the cell is ready", START_TIMEOUT_S)
        text = config.read_text().replace("[guard]\n", f"{PATIENT_GUARD}[guard]\n")
        text = text.replace("[gripper.robotiq]\n", "[gripper.robotiq]\ntimeout_ms = 400\n")
        patient.write_text(text.replace('.sock"\n', '.sock"\nstall_ms = 1000\n', 2))
        self._start("daemon", "-m", "slipguard", "run", "--config", str(patient))
