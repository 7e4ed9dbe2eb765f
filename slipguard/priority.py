"""Who may wait: what is not the guard takes the time that the guard leaves.

The service runs with real-time priority (`systemd/slipguard.service`), which every thread and process that it starts
inherits.
"""

from __future__ import annotations

import contextlib
import os

from slipguard.errors import SlipguardError

FIRST = 1
"""The lowest real-time priority comes before everything that has none, and behind what the kernel itself needs."""


def go_first() -> None:
    """Real-time priority as in the service: for this thread, and those it will start. Raises SlipguardError."""
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(FIRST))
    except OSError as error:
        why = f"real-time priority is refused here ({error.strerror}); run it as root, or allow it with `ulimit -r 1`"
        raise SlipguardError(why) from None


def stand_back(niceness: int) -> None:
    """Give way from now on: this thread, and the threads and processes it will start, on Linux.

    niceness: 0 ... 19, among those that give way. A system that forbids even that leaves it as it is.
    """
    with contextlib.suppress(OSError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))  # whoever it wakes for, it interrupts nobody
        os.nice(niceness)
