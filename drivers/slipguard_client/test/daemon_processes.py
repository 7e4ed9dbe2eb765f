"""slipguard's daemon as a process, for the tests of the ROS 2 and LeRobot packages."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Any

import pytest
from slipguard_demo import EmulatedCell, wait_until

__all__ = ["Daemon", "is_busy", "slipguard_python", "wait_until"]
LIGHT_DAEMON = Path(__file__).resolve().parents[3] / "tests" / "wire" / "light_daemon.py"


def slipguard_python() -> str:
    """Return the interpreter of slipguard's environment, from SLIPGUARD_PYTHON."""
    python = os.environ.get("SLIPGUARD_PYTHON")
    if python is None:
        pytest.exit("set SLIPGUARD_PYTHON to the Python of slipguard's environment, such as .venv/bin/python", 2)
    return python


def is_busy() -> bool:
    """Return whether this machine is too busy to judge rates and times."""
    return os.getloadavg()[0] > (os.cpu_count() or 1)


class Daemon(EmulatedCell):
    """A daemon whose simulated devices cost nothing, so that a busy machine does not matter."""

    def place(self) -> None:
        time.sleep(0.5)  # the simulation does it

    def start_processes(self) -> None:
        mode = ["guard-mode"] if self.mode == "guard" else []
        state = self.folder / "state"
        self.start_process("daemon", *self.program, str(LIGHT_DAEMON), str(self.folder), str(state), *mode)

    def grasp(self, **fields: Any) -> dict[str, Any]:
        """Grasp, and wait until the object is held; return the state."""
        self.api.submit("grasp", fields)
        return self.wait_for("holding")
