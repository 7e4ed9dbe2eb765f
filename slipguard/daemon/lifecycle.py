"""Start, watchdog and end of the daemon's process: messages to systemd, and a shutdown that always ends."""

from __future__ import annotations

import asyncio
import os
import socket
import threading
from collections.abc import Callable

import structlog

CANCEL_AGAIN_S = 6.0
"""The web process may take 5 s for its last responses, and the recorder as long for its file."""
EXIT_S = 8.0
"""A hanging thread or loop cannot be cancelled. Less than `TimeoutStopSec` of the systemd unit."""
log = structlog.get_logger()


def notify_systemd(message: str) -> bool:
    """Send one sd_notify datagram (`READY=1`, `WATCHDOG=1`, `STATUS=...`, `STOPPING=1`); False without systemd."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        sender.setblocking(False)  # a stalled receiver must not stop the control loop
        try:
            sender.connect(address)
            sender.sendall(message.encode())
        except OSError:
            return False
    return True


def watchdog_period_s() -> float | None:
    """Return half of systemd's WatchdogSec, the longest gap between two `WATCHDOG=1`; None without a watchdog."""
    raw = os.environ.get("WATCHDOG_USEC", "")
    return int(raw) / 2e6 if raw.isdigit() and int(raw) > 0 else None


class Shutdown:
    """Cancels tasks again that did not end, and finally exits the process. The grip stays as it is in any case.

    To be made in the task that waits for all others.

    Args:
        exit_process: Ends the process at once, with this exit status.
    """

    def __init__(self, exit_process: Callable[[int], None] = os._exit) -> None:
        self._waiting_task = asyncio.current_task()
        self._loop = asyncio.get_running_loop()
        self._exit_process = exit_process
        self._cancel_timer: asyncio.TimerHandle | None = None
        self._exit_timer: threading.Timer | None = None

    def begin(self) -> None:
        """Start the timers; to be called once, when the other tasks are about to be cancelled."""
        self._cancel_timer = self._loop.call_later(CANCEL_AGAIN_S, self._cancel_again)
        self._exit_timer = threading.Timer(EXIT_S, self._exit)  # a thread, because the loop itself may hang
        self._exit_timer.daemon = True
        self._exit_timer.start()

    def end(self) -> None:
        """Stop the timers: all tasks have ended. Idempotent."""
        if self._cancel_timer is not None:
            self._cancel_timer.cancel()
        if self._exit_timer is not None:
            self._exit_timer.cancel()

    def _running(self) -> list[asyncio.Task[object]]:
        return [task for task in asyncio.all_tasks(self._loop) if task.cancelling() and task is not self._waiting_task]

    def _cancel_again(self) -> None:
        running = self._running()
        log.error(f"tasks did not end within {CANCEL_AGAIN_S:g} s of the stop; cancelled again", tasks=_names(running))
        for task in running:
            task.cancel()

    def _exit(self) -> None:
        try:
            tasks = _names(self._running())
            log.error(f"tasks did not end within {EXIT_S:g} s of the stop; process exits, the grip stays", tasks=tasks)
        finally:
            self._exit_process(1)


def _names(tasks: list[asyncio.Task[object]]) -> list[str]:
    return sorted(task.get_name() for task in tasks)
