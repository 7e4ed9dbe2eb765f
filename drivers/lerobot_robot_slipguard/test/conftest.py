"""slipguard's daemon, and LeRobot in this process."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "slipguard_client" / "test"))

from daemon_processes import Daemon, slipguard_python


@pytest.fixture(scope="session")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon, calibrated, with an object between the open jaws."""
    with Daemon([slipguard_python()], tmp_path_factory.mktemp("t") / "daemon", mode="guard") as running:
        yield running
