"""Real-time priority is requested in one place, and a process that lowers its priority affects only itself."""

from __future__ import annotations

import errno
import os
import subprocess
import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from slipguard.thread_priority import (
    SECOND,
    set_batch_priority,
    set_normal_priority,
    set_worker_priority,
)


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


def forbidden(*asked: object) -> None:
    raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
