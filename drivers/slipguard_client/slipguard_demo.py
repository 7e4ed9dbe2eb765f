"""A simulated cell as processes of their own, and a plot of what happened in it: for the demos of ROS 2 and LeRobot."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from slipguard_client import DaemonUnreachable, LocalApi, RequestRefused

START_TIMEOUT_S = 90.0
OPEN_MM = 60.0
PATIENT_GUARD = """watchdog_hz = 2
[guard.tuning]
frames_timeout_s = 5
gripper_timeout_s = 5
arm_timeout_s = 5
cycle_timeout_s = 5
tighten_effect_timeout_s = 8
"""
"""A real cell is not simulated on the machine that guards it: here a busy machine is no fault."""
OBJECT = "bar 0"
"""An object and the seed of its friction: it slips in a grip of 40 N."""


def wait_until(reached: Callable[[], Any], what: str, within_s: float = 30.0) -> Any:
    """Wait until `reached` returns a true value, and return it. Raises AssertionError."""
    ends_s = time.monotonic() + within_s
    while not (value := reached()):
        assert time.monotonic() < ends_s, f"not within {within_s:g} s: {what}"
        time.sleep(0.02)
    return value


class EmulatedCell:
    """`slipguard emulate cell` and the daemon, calibrated. In mode guard the cell's robot lifts what is gripped.

    program: starts slipguard. folder: receives socket, logs and recordings. placed: name and seed of the object.
    """

    def __init__(
        self, program: Sequence[str], folder: Path, mode: str = "lift", placed: str = OBJECT, height_mm: float = 60.0
    ) -> None:
        self.program, self.folder, self.mode = [*program], folder, mode
        self.placed, self.height_mm = placed, height_mm
        self.socket = str(folder / "slipguard.sock")
        self.api = LocalApi(self.socket)
        self._processes: list[subprocess.Popen[str]] = []

    def __enter__(self) -> EmulatedCell:
        self.folder.mkdir(exist_ok=True)
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start the processes and wait until all devices are ready."""
        try:
            self.start_processes()
            wait_until(self._is_ready, "the daemon is ready", START_TIMEOUT_S)
            wait_until(self._calibrate, "calibrated", START_TIMEOUT_S)
        except BaseException:
            self.stop()
            raise

    def stop(self) -> None:
        """End the processes; the simulated grip ends with them."""
        while self._processes:
            process = self._processes.pop()
            process.send_signal(signal.SIGTERM)
            try:
                process.wait(30.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()

    def state(self) -> dict[str, Any]:
        """Return the daemon's state."""
        return self.api.state()

    def wait_for(self, *phases: str, within_s: float = 30.0) -> dict[str, Any]:
        """Wait for one of the phases; return the state. Raises AssertionError, also for a fault."""

        def reached() -> dict[str, Any] | None:
            state = self.state()
            assert "fault" in phases or not state["fault"], state["fault"]
            return state if state["phase"] in phases else None

        return dict(wait_until(reached, f"phase {' or '.join(phases)}", within_s))

    def release(self) -> None:
        """Open the jaws, and place the object between them again. Starts the daemon if it has ended."""
        if not self._processes or self._processes[-1].poll() is not None:
            self.stop()
            self.start()
        state = self.state()
        if state["phase"] != "idle" or state["gripper"]["width_mm"] < OPEN_MM:
            self.api.submit("release", {"confirm": True})
            wait_until(lambda: self.state()["phase"] == "idle", "released")
            wait_until(lambda: self.state()["gripper"]["width_mm"] > OPEN_MM, "the jaws are open")
        self.place()

    def place(self) -> None:
        """Place the object between the open jaws."""
        emulator = self._processes[0].stdin
        assert emulator is not None
        emulator.write(f"place {self.placed}\n")
        emulator.flush()

    def start_processes(self) -> None:
        """Start the emulator, then the daemon."""
        name, seed = self.placed.split()
        host = f"127.{20 + os.getpid() // 256 % 200}.{os.getpid() % 256}.80"  # the ports of a robot cannot be chosen
        options = f"--object {name} --seed {seed} --fps 30 --mode {self.mode} --height-mm {self.height_mm:g}"
        where = f"--play-again-s 0.5 --activated --robot-on --folder {self.folder} --host {host}"
        self.start_process("emulate", *self.program, "emulate", "cell", *options.split(), *where.split())
        config = self.folder / "config.toml"
        wait_until(lambda: config.exists() and "[state]" in config.read_text(), "the cell is ready", START_TIMEOUT_S)
        used = self.folder / "used.toml"
        text = config.read_text().replace("[guard]\n", f"{PATIENT_GUARD}[guard]\n")
        text = text.replace("[gripper.robotiq]\n", "[gripper.robotiq]\ntimeout_ms = 400\n")
        used.write_text(text.replace('.sock"\n', '.sock"\nstall_ms = 1000\n', 2))
        self.start_process("daemon", *self.program, "run", "--config", str(used))

    def start_process(self, name: str, *command: str) -> None:
        """Start a process with its output in a file."""
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        environment |= {"HOME": str(self.folder), "OMP_NUM_THREADS": "1"}
        with (self.folder / f"{name}.txt").open("a") as out:
            process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=out, stderr=out, text=True, env=environment
            )
        self._processes.append(process)

    def _calibrate(self) -> bool:
        with contextlib.suppress(RequestRefused):  # a busy machine may be late with a frame
            return bool(self.api.submit("calibrate"))
        return False

    def _is_ready(self) -> bool:
        assert self._processes[-1].poll() is None, (self.folder / "daemon.txt").read_text()
        with contextlib.suppress(DaemonUnreachable, RequestRefused):
            return not self.state()["waiting_for"]
        return False


def plot(episodes: dict[str, dict[str, list[tuple[float, float]]]], path: str) -> None:
    """Plot episodes beside each other. episodes: by title, curves by label: times in seconds and values."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.0 * len(episodes), 6.0), layout="constrained")
    axes = figure.subplots(2, len(episodes), sharex=True, sharey="row")
    for column, (title, curves) in enumerate(episodes.items()):
        began_s = min(at_s for values in curves.values() for at_s, _ in values)
        axes[0, column].set_title(title)
        axes[1, column].set_xlabel("time [s]")
        for row, (label, values) in enumerate(curves.items()):
            axes[row, column].plot(
                [at_s - began_s for at_s, _ in values], [one for _, one in values], ".-", markersize=2
            )
            axes[row, column].grid(alpha=0.3)
            axes[row, 0].set_ylabel(label)
    figure.savefig(path, dpi=120)
