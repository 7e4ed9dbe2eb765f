"""Which tests a plain `python -m pytest` runs, in how many processes, and in which order.

Tests that compute share all cores. Of the tests that wait for emulated devices, those of one kind run one after the
other. Tests of real time run last, alone, so that no other test takes the cores from them.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from xdist.workermanage import WorkerController

REAL_DATA_VARIABLE = "SLIPGUARD_REAL_DATA"
ON_DEMAND = ("browser", "campaign", "extras", "real", "service", "vm")
"""Markers of tests that run only if a path or `-m` selects them, as `.ci/run` does."""
SERIAL_FOLDERS = {"contract": "contracts", **dict.fromkeys(("browser", "service", "vm", "wire"), "whole programs")}
"""Of the tests in folders of the same kind, never two run at once."""
LONG_FOLDERS = {"loop", "packaging", "stress", "web"}
"""Their tests start first, so that no process ends long after the others."""
WAITING_WORKERS = 1
"""Processes beyond one per core: the tests in SERIAL_FOLDERS wait most of the time."""
REALTIME = "realtime"
CLOSING_LINE = (
    "Tests that need a browser, a virtual machine, real images or optional packages, and long campaigns: "
    "see tests/README.md."
)


def choose_workers(config: pytest.Config) -> None:
    """Use all cores if no path was given: a developer's choice of a few tests runs in one process."""
    config.option.whole_suite = config.args_source is pytest.Config.ArgsSource.TESTPATHS
    if not config.option.whole_suite:
        config.option.reportchars += "s"  # say why a test that was chosen is skipped
    one_process = config.option.collectonly or config.option.usepdb or hasattr(config, "workerinput")
    if config.option.whole_suite and not one_process and getattr(config.option, "numprocesses", 0) is None:
        config.option.numprocesses = len(os.sched_getaffinity(0)) + WAITING_WORKERS


def select(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Leave out the tests on demand, and put the others in order."""
    if config.option.whole_suite and not config.option.markexpr:
        items[:] = [item for item in items if not any(item.get_closest_marker(name) for name in ON_DEMAND)]
    items.sort(key=_rank)
    if hasattr(config, "workerinput"):
        names = [item.nodeid for item in items if item.get_closest_marker(REALTIME)]
        Path(config.workerinput[REALTIME]).write_text("\n".join(names))


def _rank(item: pytest.Item) -> int:
    if item.get_closest_marker(REALTIME):
        return 3
    folders = set(item.path.parts)
    return 0 if SERIAL_FOLDERS.keys() & folders else 1 if LONG_FOLDERS & folders else 2


def need_what_it_names(item: pytest.Item) -> None:
    """Skip a test whose packages or images are missing; fail it if `-m` asked for it."""
    missing = [name for marker in item.iter_markers("extras") for name in marker.args if not _has(name)]
    if item.get_closest_marker("real") and not os.environ.get(REAL_DATA_VARIABLE):
        missing.append(f"{REAL_DATA_VARIABLE} (a folder of DIGIT recordings)")
    if not missing:
        return
    reason = f"needs {', '.join(missing)}; see tests/README.md"
    if item.config.option.markexpr:
        pytest.fail(reason, pytrace=False)
    pytest.skip(reason)


def _has(name: str) -> bool:
    """Return whether a module, a program, or the rights of root are there."""
    if name == "root":
        return os.geteuid() == 0
    return shutil.which(name) is not None or importlib.util.find_spec(name) is not None


def set_list_file(node: WorkerController) -> None:
    """Name the file in which a worker lists its tests of real time: the scheduler knows the tests by name only."""
    node.workerinput[REALTIME] = str(node.config._tmp_path_factory.getbasetemp() / REALTIME)


def make_scheduler(config: pytest.Config, log: Any) -> Any:
    """Give each process one file or serial folder at a time, and the tests of real time to the last process."""
    from xdist.scheduler import LoadScopeScheduling

    class RealTimeLast(LoadScopeScheduling):
        def schedule(self) -> None:
            listed = config._tmp_path_factory.getbasetemp() / REALTIME
            self.realtime = set(listed.read_text().splitlines())
            super().schedule()

        def _split_scope(self, nodeid: str) -> str:
            if nodeid in self.realtime:
                return REALTIME
            path = nodeid.partition("::")[0]
            return SERIAL_FOLDERS.get(path.split("/")[1], path)

        def _reschedule(self, node: WorkerController) -> None:
            if list(self.workqueue) != [REALTIME] or node.shutting_down:
                super()._reschedule(node)
            elif any(not other.shutting_down for other in self.nodes if other is not node):
                if self._pending_of(self.assigned_work[node]) <= 1:
                    node.shutdown()
            elif len(self.nodes) == 1:
                super()._reschedule(node)

        def remove_node(self, node: WorkerController) -> str | None:
            crashed = super().remove_node(node)
            for other in self.nodes:
                self._reschedule(other)
            return crashed

    config.option.loadscopereorder = False
    return RealTimeLast(config, log)
