"""slipguard's daemon, and LeRobot in this process."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "slipguard_client" / "test"))

from daemon_processes import Daemon


@pytest.fixture(scope="session")
def slipguard_python() -> str:
    """Return the interpreter of slipguard's environment, from SLIPGUARD_PYTHON."""
    python = os.environ.get("SLIPGUARD_PYTHON")
    if python is None:
        pytest.exit("set SLIPGUARD_PYTHON to the Python of slipguard's environment, such as .venv/bin/python", 2)
    return python


@pytest.fixture(scope="session")
def daemon(slipguard_python: str, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon, calibrated, with an object between the open jaws."""
    with Daemon(slipguard_python, tmp_path_factory.mktemp("t") / "daemon", mode="guard") as running:
        yield running
