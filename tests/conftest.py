"""Shared by all suites: real data, virtual time, and a test that leaves a task behind fails."""

from __future__ import annotations

import asyncio
import importlib.util
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from deselection import closing_lines, leave_out, receive, send

REAL_DATA_VARIABLE = "SLIPGUARD_REAL_DATA"


def pytest_configure() -> None:
    """No test is timed. The test machine, which runs contract suites only, has no hypothesis."""
    if importlib.util.find_spec("hypothesis") is not None:
        from hypothesis import settings

        settings.register_profile("untimed", deadline=None)
        settings.load_profile("untimed")


def pytest_addoption(parser: pytest.Parser) -> None:
    """Real devices for the contract suites. They move; without these options no test touches one."""
    group = parser.getgroup("slipguard", "contract suites on real hardware")
    group.addoption("--gripper", metavar="PORT", help="a real gripper's serial port, such as /dev/ttyUSB0")
    group.addoption("--gripper-object", action="store_true", help="something to grip lies between its jaws throughout")
    group.addoption("--arm", metavar="HOST", help="a real arm's address, such as 192.0.2.10")
    group.addoption("--arm-campaign", type=int, default=5, metavar="N", help="faults of the arm's link")
    group.addoption("--commands", type=int, default=300, help="length of the gripper's campaign of faults")
    group.addoption("--seed", type=int, default=0, help="seed of the gripper's campaign of faults, and of the kills")
    group.addoption("--kills", type=int, default=2, metavar="N", help="how often the daemon is killed in a lift")
    group.addoption("--sensor-driver", metavar="NAME", help="a sensor's driver registered by another package")
    group.addoption("--sensor-settings", metavar="JSON", default="{}", help="its table in config.toml")
    group.addoption(
        "--api-examples", type=int, default=5, metavar="N", help="made-up requests for each of the API's routes"
    )
    group.addoption("--digit", metavar="SERIAL", help="a real sensor's serial number, such as D20479")
    parser.addoption("--page-pictures", metavar="DIR", help="keep pictures of the operator page here")


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without real data the `real` tests are deselected, without MuJoCo its own; the closing lines say so."""
    if not os.environ.get(REAL_DATA_VARIABLE):
        leave_out(
            config,
            items,
            "real",
            f"on real sensor images were left out: {REAL_DATA_VARIABLE} is not set "
            "(it names a folder of DIGIT recordings that is not part of the project)",
        )
    if importlib.util.find_spec("mujoco") is None:
        leave_out(
            config, items, "mujoco", "of the mechanics beside MuJoCo were left out: pip install 'slipguard[mujoco]'"
        )
    items.sort(key=lambda item: not _shared(item.path))


def _shared(path: Path) -> bool:
    """Whether the tests of this file may share the machine with others."""
    return not {"browser", "contract", "service", "vm", "wire"} & set(path.parts)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """With `-n 2` files that only compute share the cores; then all others follow one after the other."""
    from xdist.scheduler import LoadScopeScheduling

    class OneAfterTheOther(LoadScopeScheduling):
        def _split_scope(self, nodeid: str) -> str:
            path = nodeid.partition("::")[0]
            return path if _shared(Path(path)) else "one after the other"

    config.option.loadscopereorder = False
    return OneAfterTheOther(config, log)


def pytest_sessionfinish(session: pytest.Session) -> None:
    send(session.config)


@pytest.hookimpl(optionalhook=True)
def pytest_testnodedown(node: Any) -> None:
    receive(node.config, getattr(node, "workeroutput", {}))


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    for line in closing_lines(config):
        terminalreporter.write_line(line)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """The folder of real sensor images; set but missing is a failure, not a skip."""
    folder = Path(os.environ[REAL_DATA_VARIABLE])
    assert folder.is_dir(), f"{REAL_DATA_VARIABLE} names {folder}, which is not a folder"
    return folder


@pytest.fixture(autouse=True)
async def _no_leaked_tasks(request: pytest.FixtureRequest) -> AsyncIterator[None]:
    yield
    this = asyncio.current_task()
    left = [task for task in asyncio.all_tasks() if task is not this and not task.done()]
    assert not left, f"left running: {[task.get_name() for task in left]}"
