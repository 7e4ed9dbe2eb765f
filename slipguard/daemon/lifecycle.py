"""Start, watchdog and end of the daemon's process: messages to systemd, and a shutdown that always ends."""

from __future__ import annotations

import asyncio
import os
import signal
import socket
import threading
from collections.abc import Callable

import structlog

from slipguard.daemon import log_setup

CANCEL_AGAIN_S = 6.0
"""The web process may take 5 s for its last responses, and the recorder as long for its file."""
EXIT_S = 8.0
"""A hanging thread or loop cannot be cancelled. Less than `TimeoutStopSec` of the systemd unit."""
FLUSH_S = 0.5
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


def ignore_signal(name: str) -> None:
    """Log a signal that would end the process by default; nothing else happens."""
    log.warning(f"{name} ignored; SIGTERM stops slipguard, SIGHUP reloads the configuration")


def exit_if_stuck(exit_process: Callable[[int], None] = os._exit) -> None:
    """Exit the process `EXIT_S` from now, unless it has ended by then. The grip stays as it is.

    To be called when the daemon is asked to stop, and not to be cancelled: after the tasks have ended, asyncio and
    Python wait for each thread without limit, for example for one that reads from a dead disk.

    Args:
        exit_process: Ends the process at once, with this exit status.
    """
    loop = asyncio.get_running_loop()

    def leave() -> None:
        try:
            tasks = _names([task for task in asyncio.all_tasks(loop) if task.cancelling()])
            threads = sorted(one.name for one in threading.enumerate() if not one.daemon and one.name != "MainThread")
            text = f"did not end within {EXIT_S:g} s of the stop; the process exits, the grip stays"
            log.error(f"tasks or threads {text}", tasks=tasks, threads=threads)
            log_setup.flush(FLUSH_S)
        finally:
            exit_process(1)

    timer = threading.Timer(EXIT_S, leave)  # a thread, because the loop itself may hang
    timer.daemon = True
    try:
        timer.start()
    except RuntimeError:  # no more threads: then by the kernel, without a log line
        loop.remove_signal_handler(signal.SIGALRM)
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
        signal.alarm(round(EXIT_S))


class Shutdown:
    """Cancels tasks again that did not end. To be made in the task that waits for all others."""

    def __init__(self) -> None:
        self._waiting_task = asyncio.current_task()
        self._loop = asyncio.get_running_loop()
        self._timer: asyncio.TimerHandle | None = None

    def begin(self) -> None:
        """Start the timer; to be called once, when the other tasks are about to be cancelled."""
        self._timer = self._loop.call_later(CANCEL_AGAIN_S, self._cancel_again)

    def end(self) -> None:
        """Stop the timer: all tasks have ended. Idempotent."""
        if self._timer is not None:
            self._timer.cancel()

    def _cancel_again(self) -> None:
        every = asyncio.all_tasks(self._loop)
        running = [task for task in every if task.cancelling() and task is not self._waiting_task]
        log.error(f"tasks did not end within {CANCEL_AGAIN_S:g} s of the stop; cancelled again", tasks=_names(running))
        for task in running:
            task.cancel()


def _names(tasks: list[asyncio.Task[object]]) -> list[str]:
    return sorted(task.get_name() for task in tasks)
