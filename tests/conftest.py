"""Common to all suites: options, the order of the tests, and a failure if a test leaves a task running."""

from __future__ import annotations

import asyncio
import importlib.util
import os
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import pytest
from realtime import RealTime
from run_order import (
    CLOSING_LINE,
    REAL_DATA_VARIABLE,
    choose_workers,
    make_scheduler,
    need_what_it_names,
    select,
    set_list_file,
)

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as slipguard's own main does; before numpy is imported


def pytest_addoption(parser: pytest.Parser) -> None:
    """Real devices for the contract suites. They move; without these options no test touches one."""
    group = parser.getgroup("slipguard", "contract suites on real hardware, lengths of campaigns")
    group.addoption("--gripper", metavar="PORT", help="serial port of a real gripper, such as /dev/ttyUSB0")
    group.addoption("--gripper-object", action="store_true", help="an object lies between its jaws all the time")
    group.addoption("--arm", metavar="HOST", help="address of a real arm, such as 192.0.2.10")
    group.addoption("--digit", metavar="SERIAL", help="serial number of a real sensor, such as D20479")
    for device in ("sensor", "gripper", "arm"):
        group.addoption(f"--{device}-driver", metavar="NAME", help=f"a {device} driver that another package registers")
        group.addoption(f"--{device}-settings", metavar="JSON", default="{}", help="its table in config.toml, as JSON")
    group.addoption("--arm-campaign", type=int, default=5, metavar="N", help="faults of the arm's connection")
    group.addoption("--commands", type=int, default=300, metavar="N", help="length of the gripper's fault campaign")
    group.addoption("--kills", type=int, default=2, metavar="N", help="how often the daemon is killed during a lift")
    group.addoption("--stops", type=int, default=2, metavar="N", help="how many lifts meet a protective stop")
    group.addoption("--seed", type=int, default=0, metavar="N", help="seed of faults, kills and stops")
    group.addoption("--api-examples", type=int, default=2, metavar="N", help="generated requests for each API route")
    group.addoption(
        "--judged-share", type=float, default=0.0, metavar="SHARE",
        help="fail if the machine is too busy to judge this share of the real-time tests (0 to 1)",
    )  # fmt: skip


def pytest_configure(config: pytest.Config) -> None:
    """The test machine, which runs contract suites only, has no hypothesis."""
    config.pluginmanager.register(RealTime(config.getoption("--judged-share")), "slipguard-realtime")
    if importlib.util.find_spec("hypothesis") is not None:
        from hypothesis import HealthCheck, settings
        from hypothesis.database import DirectoryBasedExampleDatabase

        # New random examples in each run. A failing one is kept, and printed with the line that repeats it.
        settings.register_profile(
            "slipguard",
            deadline=None,
            derandomize=False,
            print_blob=True,
            suppress_health_check=[HealthCheck.too_slow],
            database=DirectoryBasedExampleDatabase(Path(__file__).parents[1] / ".hypothesis" / "examples"),
        )
        settings.load_profile("slipguard")


@pytest.hookimpl(tryfirst=True)
def pytest_cmdline_main(config: pytest.Config) -> None:
    choose_workers(config)


@pytest.hookimpl(trylast=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    select(config, items)


@pytest.hookimpl(optionalhook=True)
def pytest_configure_node(node: Any) -> None:
    set_list_file(node)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    return make_scheduler(config, log)


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> None:
    need_what_it_names(item)


@pytest.hookimpl(tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    if config.option.whole_suite and not config.option.markexpr:
        terminalreporter.write_line(CLOSING_LINE)


@pytest.fixture(scope="session")
def real_data() -> Path:
    """Return the folder of real sensor images; a folder that is named but missing is a failure."""
    folder = Path(os.environ[REAL_DATA_VARIABLE])
    assert folder.is_dir(), f"{REAL_DATA_VARIABLE} names {folder}, which is not a folder"
    return folder


@pytest.fixture(autouse=True)
async def _no_leaked_tasks(request: pytest.FixtureRequest) -> AsyncIterator[None]:
    yield
    this = asyncio.current_task()
    left = [task for task in asyncio.all_tasks() if task is not this and not task.done()]
    assert not left, f"left running: {[task.get_name() for task in left]}"
