"""The daemon and the node as processes, as a user starts them."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slipguard_ros.local_api import DaemonUnreachable, LocalApi, RequestRefused

START_TIMEOUT_S = 60.0
LIGHT_DAEMON = Path(__file__).resolve().parents[3] / "tests" / "wire" / "light_daemon.py"
CONFIG = """
[state]
directory = "{folder}/state"
[api]
socket = "{socket}"
listen = ""
[guard.tuning]  # for a busy machine
frames_timeout_s = 1.5
gripper_timeout_s = 2
arm_timeout_s = 2
cycle_timeout_s = 2
tighten_effect_timeout_s = 4
"""


def wait_until(reached: Callable[[], bool], what: str, within_s: float = 30.0) -> float:
    """Wait until `reached`; return how long that took. Raises AssertionError."""
    began_s = time.monotonic()
    while not reached():
        assert time.monotonic() - began_s < within_s, f"not within {within_s:g} s: {what}"
        time.sleep(0.02)
    return time.monotonic() - began_s


class SimulatedDaemon:
    """The daemon with simulated devices, on a socket of its own.

    python: the interpreter of slipguard's environment. rendered: `slipguard run --sim`, with rendered and segmented
    images; otherwise images cost nothing, so that a busy machine does not matter.
    """

    def __init__(self, python: str, folder: Path, rendered: bool = False) -> None:
        self.socket = str(folder / "slipguard.sock")
        self.recordings = folder / "state" / "recordings"
        self.api = LocalApi(self.socket)
        self._folder = folder
        self._command = [python, str(LIGHT_DAEMON), str(folder), str(folder / "state")]
        if rendered:
            self._command = [python, "-m", "slipguard", "run", "--sim", "--config", str(folder / "config.toml")]
        self._process: subprocess.Popen[bytes] | None = None
        (folder / "state").mkdir(exist_ok=True)
        (folder / "config.toml").write_text(CONFIG.format(folder=folder, socket=self.socket))

    def __enter__(self) -> SimulatedDaemon:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.stop()

    def start(self) -> None:
        """Start it and wait until all devices are ready."""
        environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
        with (self._folder / "daemon.log").open("ab") as log:
            self._process = subprocess.Popen(self._command, stdout=log, stderr=log, env=environment)

        def ready() -> bool:
            assert self._process is not None
            assert self._process.poll() is None, (self._folder / "daemon.log").read_text()
            with contextlib.suppress(DaemonUnreachable, RequestRefused):
                return not self.api.state()["waiting_for"]
            return False

        wait_until(ready, "the daemon is ready", START_TIMEOUT_S)

    def stop(self) -> None:
        """End it; the simulated grip ends with it."""
        assert self._process is not None
        self._process.send_signal(signal.SIGTERM)
        self._process.wait(20.0)

    def state(self) -> dict[str, Any]:
        """Return the state."""
        return self.api.state()

    def wait_for(self, phase: str, within_s: float = 30.0) -> None:
        """Wait for a phase."""

        def reached() -> bool:
            state = self.state()
            assert not state["fault"], state["fault"]
            return bool(state["phase"] == phase)

        wait_until(reached, f"phase {phase}", within_s)

    def release(self) -> None:
        """Open the jaws, and wait until the next object can be gripped; start the daemon if a test has ended it."""
        if self._process is None or self._process.poll() is not None:
            self.start()
            return
        state = self.state()
        if state["phase"] != "idle" or state["gripper"]["width_mm"] < 60.0:
            self.api.submit("release", {"confirm": True})
            self.wait_for("idle")
            wait_until(lambda: self.state()["gripper"]["width_mm"] >= 60.0, "the jaws are open")
        time.sleep(0.5)  # the simulation places the next object


class NodeProcess:
    """The node, `slipguard_node`."""

    def __init__(self, socket_path: str, *parameters: str, parameter_file: Path | None = None) -> None:
        words = [] if parameter_file is None else ["--params-file", str(parameter_file)]
        words += [word for one in (f"socket:={socket_path}", *parameters) for word in ("-p", one)]
        self._command = [sys.executable, "-m", "slipguard_ros.node", "--ros-args", *words]
        self._process: subprocess.Popen[bytes] | None = None

    def __enter__(self) -> NodeProcess:
        self.start()
        return self

    def __exit__(self, *_: object) -> None:
        assert self.stop() == 0, "the node did not end cleanly"

    def start(self) -> None:
        """Start it; does not wait."""
        self._process = subprocess.Popen(self._command)

    def stop(self) -> int:
        """Interrupt it as ros2 launch does; return its exit status."""
        assert self._process is not None
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        return self._process.wait(20.0)

    def kill(self) -> None:
        """End it at once."""
        assert self._process is not None
        self._process.kill()
        self._process.wait(20.0)
