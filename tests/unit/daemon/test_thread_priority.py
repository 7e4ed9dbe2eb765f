"""Real-time priority is requested in one place, and a process that lowers its priority affects only itself."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
import structlog

from slipguard.cli.app import run
from slipguard.errors import SlipguardError
from slipguard.thread_priority import (
    FIRST,
    SECOND,
    set_batch_priority,
    set_normal_priority,
    set_realtime_priority,
    set_worker_priority,
)

UNTIL_IT_STANDS_BACK = """
import os, runpy, sys
module, *heavy = sys.argv[1:]
def stands_back(*asked):
    print("stands back, with", [name for name in heavy if name in sys.modules], flush=True)
    os._exit(0)
os.sched_setscheduler = stands_back
runpy.run_module(module, run_name="__main__")
"""


def standing() -> tuple[int, int]:
    return os.sched_getscheduler(0), os.getpriority(os.PRIO_PROCESS, threading.get_native_id())


def test_batch_priority_applies_to_one_thread_and_its_children() -> None:
    before = standing()
    with ThreadPoolExecutor(1) as back:
        back.submit(set_batch_priority, 7).result()
        policy, niceness = back.submit(standing).result()
        child = back.submit(subprocess.check_output, ("cat", "/proc/self/stat"), text=True).result()
    assert (policy, niceness) == (os.SCHED_BATCH, min(before[1] + 7, 19))
    fields = child.rpartition(")")[2].split()  # from the third value on, its state
    assert (int(fields[41 - 3]), int(fields[19 - 3])) == (policy, niceness)
    assert standing() == before


def test_normal_priority_applies_to_the_threads_and_processes_that_are_started() -> None:
    with ThreadPoolExecutor(1, initializer=set_batch_priority, initargs=(0,)) as back:
        assert back.submit(standing).result()[0] == os.SCHED_BATCH
        back.submit(set_normal_priority).result()
        assert back.submit(standing).result()[0] == os.SCHED_OTHER


@pytest.mark.parametrize("module", ["slipguard.web", "slipguard_drivers.digit.render_process"])
def test_batch_processes_set_their_priority_before_heavy_imports(module: str) -> None:
    heavy = ("asyncio", "cv2", "fastapi", "numpy", "slipguard.sim", "starlette", "structlog", "uvicorn")
    output = subprocess.check_output((sys.executable, "-c", UNTIL_IT_STANDS_BACK, module, *heavy), text=True)
    assert output == "stands back, with []\n"


def test_a_forbidden_priority_change_has_no_effect(monkeypatch: pytest.MonkeyPatch) -> None:
    before = standing()
    monkeypatch.setattr(os, "sched_setscheduler", forbidden)
    set_batch_priority(7)
    assert standing() == before


def test_the_loop_gets_the_second_lowest_realtime_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int, int]] = []

    def noted(pid: int, policy: int, how: os.sched_param) -> None:
        asked.append((pid, policy, how.sched_priority))

    monkeypatch.setattr(os, "sched_setscheduler", noted)
    set_realtime_priority()
    assert asked == [(0, os.SCHED_RR, FIRST)]
    assert os.sched_get_priority_min(os.SCHED_RR) == SECOND < FIRST


def test_workers_get_the_lowest_realtime_priority(monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[tuple[int, int]] = []
    monkeypatch.setattr(os, "sched_setparam", lambda pid, how: asked.append((pid, how.sched_priority)))
    set_worker_priority()
    assert asked == [], "nothing of it without real-time priority"
    monkeypatch.setattr(os, "sched_getscheduler", lambda pid: os.SCHED_RR)
    with ThreadPoolExecutor(1, initializer=set_worker_priority) as pool:
        pool.submit(standing).result()
    assert asked == [(0, SECOND)]
    monkeypatch.setattr(os, "sched_setparam", forbidden)
    set_worker_priority()


def test_refused_realtime_priority_is_an_error_that_says_what_to_do(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "sched_setscheduler", forbidden)
    with pytest.raises(SlipguardError, match=r"Operation not permitted.*root"):
        set_realtime_priority()
    assert run(["latency", "--as-service"]) != 0
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "ulimit -r 2" in line
    structlog.reset_defaults()  # the command has configured the log


def forbidden(*asked: object) -> None:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
