"""slipguard's daemons, and LeRobot in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).parent))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "slipguard_client" / "test"))

from daemon_processes import Daemon, EmulatedCell


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a short path, for sockets."""
    return tmp_path_factory.mktemp("t")


@pytest.fixture(scope="session")
def slipguard_python() -> str:
    """Return the interpreter of slipguard's environment, from SLIPGUARD_PYTHON."""
    python = os.environ.get("SLIPGUARD_PYTHON")
    if python is None:
        pytest.exit("set SLIPGUARD_PYTHON to the Python of slipguard's environment, such as .venv/bin/python", 2)
    return python


@pytest.fixture(scope="module")
def daemon(slipguard_python: str, folder: Path) -> Iterator[Daemon]:
    """A daemon, calibrated, with an object between the open jaws."""
    with Daemon(slipguard_python, folder / "daemon", mode="guard") as running:
        yield running


@pytest.fixture(scope="session")
def cell(slipguard_python: str, folder: Path) -> Iterator[EmulatedCell]:
    """An emulated cell and its daemon, calibrated, with an object between the open jaws."""
    with EmulatedCell(slipguard_python, folder / "cell", mode="guard") as running:
        yield running
