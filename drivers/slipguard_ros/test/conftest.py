"""A simulated daemon, the node in a process of its own, and a ROS client in this one."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "slipguard_client" / "test"))

import pytest
from daemon_processes import Daemon, slipguard_python
from ros_client import NodeProcess, RosClient


@pytest.fixture(scope="session")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon, calibrated, in a folder with a short path."""
    folder = tmp_path_factory.mktemp("ros")
    os.environ["ROS_LOG_DIR"] = str(folder / "ros_log")
    with Daemon([slipguard_python()], folder / "daemon") as running:
        yield running


@pytest.fixture
def node(daemon: Daemon) -> Iterator[NodeProcess]:
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
