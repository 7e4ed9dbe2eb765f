"""Scheduling priorities: the control loop first, its worker threads second, everything else in the remaining time.

The service runs with real-time priority (`systemd/slipguard.service`), which its threads and processes inherit.
"""

from __future__ import annotations

import contextlib
import os

FIRST, SECOND = 2, 1
"""Real-time priorities of the loop and of its workers, so that a waking loop interrupts a worker. They are the two
lowest: above all programs without real-time priority, and below the kernel's own threads."""


def set_worker_priority() -> None:
    """Set a priority below the loop's for this thread and those it starts; no effect without real-time priority."""
    with contextlib.suppress(OSError):
        if os.sched_getscheduler(0) == os.SCHED_RR:
            os.sched_setparam(0, os.sched_param(SECOND))  # the service may not make any other call


def set_normal_priority() -> None:
    """Set the priority of an ordinary program for this thread and those it starts; no effect if not permitted."""
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))


def set_batch_priority(niceness: int) -> None:
    """Set the lowest kind of priority for this thread and the threads and processes it starts.

    niceness: 0 ... 19, relative to other programs of this kind. No effect on a system that does not permit it.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(
            0, os.SCHED_BATCH, os.sched_param(0)
        )  # a batch thread that wakes interrupts no other thread
        os.nice(niceness)
