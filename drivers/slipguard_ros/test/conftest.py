"""A simulated daemon, the node in a process of its own, and a ROS client in this one."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

import pytest
from ros_client import RosClient
from rosprocesses import NodeProcess, SimulatedDaemon


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder for sockets and logs, with a short path."""
    made = tmp_path_factory.mktemp("ros")
    os.environ["ROS_LOG_DIR"] = str(made / "ros_log")
    return made


@pytest.fixture(scope="session")
def daemon(folder: Path) -> Iterator[SimulatedDaemon]:
    """`slipguard run --sim`, calibrated. SLIPGUARD names the program."""
    program = os.environ.get("SLIPGUARD") or shutil.which("slipguard")
    if program is None:
        pytest.exit("slipguard was not found; set SLIPGUARD to its path, such as .venv/bin/slipguard", 2)
    with SimulatedDaemon(program, folder) as running:
        running.api.submit("calibrate", {}, 40.0)
        yield running


@pytest.fixture
def node(daemon: SimulatedDaemon) -> Iterator[NodeProcess]:
    """The node, active."""
    with NodeProcess(daemon.socket) as running:
        yield running


@pytest.fixture
def ros() -> Iterator[RosClient]:
    """A client that receives all topics of the node."""
    client = RosClient()
    yield client
    client.close()


@pytest.fixture(autouse=True)
def emptied(request: pytest.FixtureRequest) -> Iterator[None]:
    """After each test, nothing is held."""
    yield
    if "daemon" in request.fixturenames:
        request.getfixturevalue("daemon").release()


def pytest_report_header() -> str:
    """Show which ROS is tested."""
    found = subprocess.run(["uname", "-r"], capture_output=True, text=True, check=False).stdout.strip()
    return f"ROS domain {os.environ['ROS_DOMAIN_ID']}, Linux {found}"
