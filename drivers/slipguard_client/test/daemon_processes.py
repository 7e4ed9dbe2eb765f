"""slipguard's daemon as a process, for the tests of the ROS 2 and LeRobot packages."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import slipguard_demo
from slipguard_demo import OPEN_MM, wait_until

__all__ = ["OPEN_MM", "Daemon", "EmulatedCell", "wait_until"]
LIGHT_DAEMON = Path(__file__).resolve().parents[3] / "tests" / "wire" / "light_daemon.py"


class EmulatedCell(slipguard_demo.EmulatedCell):
    """An emulated cell on a busy machine. python: the interpreter of slipguard's environment."""

    def __init__(self, python: str, folder: Path, mode: str = "lift", placed: str = "wrench 0") -> None:
        super().__init__([python, "-m", "slipguard"], folder, mode, placed, 20.0)
        self.python, self.recordings = python, folder / "state" / "recordings"

    def grasp(self, **fields: Any) -> dict[str, Any]:
        """Grasp, and wait until the object is held; return the state."""
        self.api.submit("grasp", fields)
        return self.wait_for("holding")


class Daemon(EmulatedCell):
    """A daemon whose simulated devices cost nothing, so that a busy machine does not matter."""

    def place(self) -> None:
        time.sleep(0.5)  # the simulation does it

    def start_processes(self) -> None:
        mode = ["guard-mode"] if self.mode == "guard" else []
        self.start_process(
            "daemon", self.python, str(LIGHT_DAEMON), str(self.folder), str(self.folder / "state"), *mode
        )
