"""Tell systemd how the daemon is: ready, still healthy, stopping. Silent where there is no systemd."""

from __future__ import annotations

import os
import socket


def notify(message: str) -> bool:
    """Send one sd_notify datagram (`READY=1`, `WATCHDOG=1`, `STATUS=...`, `STOPPING=1`); False if nobody listens."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as sender:
        try:
            sender.connect(address)
            sender.sendall(message.encode())
        except OSError:
            return False
    return True


def watchdog_period_s() -> float | None:
    """Half of what systemd's WatchdogSec allows between two `WATCHDOG=1`; None where no watchdog is set."""
    raw = os.environ.get("WATCHDOG_USEC", "")
    return int(raw) / 2e6 if raw.isdigit() and int(raw) > 0 else None
