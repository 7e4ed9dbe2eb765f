"""Tests of real time are judged only if the machine gives them its cores.

A test with the marker `realtime` may fail because other programs take the processor time that it needs. While such a
test runs, the processor time of all programs that it did not start is measured. If a test fails while they take more
than `LIMIT_CORES`, it is reported as not judged. A test that passes is judged in any case.
"""

from __future__ import annotations

import os
import resource
import time
from collections import defaultdict
from pathlib import Path
from threading import Event

import pytest
from run_order import REALTIME

LIMIT_CORES = 0.3
"""Other programs may use this much of the cores on average, the kernel's own work included."""
PROBE_S = 0.1
WAIT_S = 30.0
"""For a quiet machine, all tests of one run together."""
NOT_JUDGED = "not judged: machine too busy"
_TICK_S = 1.0 / os.sysconf("SC_CLK_TCK")


class Load:
    """Measures the processor time that other programs use from now on."""

    def __init__(self) -> None:
        self._begun_s, self._others_s = time.monotonic(), _all_s() - _own_s()

    def cores(self) -> float:
        """Return the average number of cores that other programs have used since then."""
        took_s = time.monotonic() - self._begun_s
        used_s = _all_s() - _own_s() - self._others_s
        return max(0.0, used_s - 2 * _TICK_S) / max(took_s, _TICK_S)


class RealTime:
    """Pytest plugin: measures while tests of real time run, and withholds judgement on a busy machine."""

    def __init__(self, judged_share: float) -> None:
        self._judged_share = judged_share
        self._judged, self._not_judged = 0, list[str]()
        self._wait_s = WAIT_S
        self._load: Load | None = None

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> object:
        """Wait a while for a quiet machine, then measure."""
        if item.get_closest_marker(REALTIME):
            self._wait_until_quiet()
            self._load = Load()
        try:
            return (yield)
        finally:
            self._load = None

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_makereport(self, item: pytest.Item) -> object:
        """Turn a failure on a busy machine into `not judged`."""
        report: pytest.TestReport = yield
        if report.failed and self._load is not None and (cores := self._load.cores()) > LIMIT_CORES:
            reason = f"{NOT_JUDGED} (other programs used {cores:.1f} cores, limit {LIMIT_CORES:g})"
            report.outcome = "skipped"
            report.longrepr = (str(item.path), (item.location[1] or 0) + 1, f"Skipped: {reason}")
        return report

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        """Count what was judged, in the process that prints."""
        if REALTIME not in report.keywords:
            return
        if report.skipped and isinstance(report.longrepr, tuple) and NOT_JUDGED in report.longrepr[2]:
            self._not_judged.append(report.longrepr[2].partition("(")[2].rstrip(")"))
        elif report.when == "call":
            self._judged += 1

    @property
    def too_few_judged(self) -> bool:
        """Whether fewer tests were judged than `--judged-share` demands."""
        return self._judged < self._judged_share * (self._judged + len(self._not_judged))

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        """Fail a run whose real-time tests say nothing, if the caller wants to know."""
        if self.too_few_judged and not hasattr(session.config, "workerinput"):
            session.exitstatus = pytest.ExitCode.TESTS_FAILED

    def pytest_terminal_summary(self, terminalreporter: pytest.TerminalReporter) -> None:
        """Say what was not judged, in one line."""
        if not self._not_judged:
            return
        every = self._judged + len(self._not_judged)
        line = f"{len(self._not_judged)} of {every} real-time tests {NOT_JUDGED} ({self._not_judged[0]})."
        if self.too_few_judged:
            line += f" At least {self._judged_share:.0%} must be judged: run them again on an idle machine."
        terminalreporter.write_line(line)

    def _wait_until_quiet(self) -> None:
        while self._wait_s > 0.0:
            load = Load()
            Event().wait(PROBE_S)
            if load.cores() <= LIMIT_CORES:
                return
            self._wait_s -= PROBE_S


def _all_s() -> float:
    """Return the processor time that everything has used on the cores this process may use."""
    try:
        lines = Path("/proc/stat").read_text().splitlines()
    except OSError:
        return 0.0
    mine = {f"cpu{core}" for core in os.sched_getaffinity(0)}
    ticks = 0
    for line in lines:
        name, *columns = line.split()
        if name in mine:
            user, nice, system, _, _, irq, softirq, steal = (int(column) for column in columns[:8])
            ticks += user + nice + system + irq + softirq + steal
    return ticks * _TICK_S


def _own_s() -> float:
    """Return the processor time of this process and of all that it has started."""
    used = [resource.getrusage(who) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(one.ru_utime + one.ru_stime for one in used) + _descendants_s()


def _descendants_s() -> float:
    """Return the processor time of the processes below this one that have not ended yet."""
    children: dict[int, list[tuple[int, int]]] = defaultdict(list)
    for pid in filter(str.isdecimal, os.listdir("/proc")):
        try:
            fields = Path("/proc", pid, "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue  # it has ended meanwhile
        ticks = sum(int(field) for field in fields[11:15])
        children[int(fields[1])].append((int(pid), ticks))
    total, parents = 0, [os.getpid()]
    while parents:
        for child, ticks in children[parents.pop()]:
            total += ticks
            parents.append(child)
    return total * _TICK_S
