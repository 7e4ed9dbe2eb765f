"""Who may wait: what is not the guard takes the time that the guard leaves.

The service runs with real-time priority (`systemd/slipguard.service`), which every thread and process that it starts
inherits.
"""

from __future__ import annotations

import contextlib
import os

from slipguard.errors import SlipguardError

FIRST, SECOND = 2, 1
"""The loop's real-time priority, and that of all who work for it: else a loop that wakes would wait for one of them to
pause. The two lowest there are: before everything that has none, and behind what the kernel itself needs."""


def set_realtime_priority() -> None:
    """Real-time priority as in the service: for this thread, and those it will start. Raises SlipguardError."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(FIRST))
    except OSError as error:
        why = f"real-time priority is refused here ({error.strerror})"
        raise SlipguardError(f"{why}; run it as root, or allow it with `ulimit -r {FIRST}`") from None


def set_worker_priority() -> None:
    """This thread, and those it will start, come behind the loop from now on; without real-time priority none does."""
    with contextlib.suppress(OSError):
        if os.sched_getscheduler(0) == os.SCHED_RR:
            os.sched_setparam(0, os.sched_param(SECOND))  # no other call is allowed to the service


def set_batch_priority(niceness: int) -> None:
    """Give way from now on: this thread, and the threads and processes it will start, on Linux.

    niceness: 0 ... 19, among those that give way. A system that forbids even that leaves it as it is.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # whoever it wakes for, it interrupts nobody
        os.nice(niceness)
