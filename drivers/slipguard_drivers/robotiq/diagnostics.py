"""What `slipguard doctor` looks at about a gripper's serial port from outside: the device file, access, the adapter."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from slipguard.diagnosis import CheckResult, note, ok, problem
from slipguard_drivers.robotiq import serial_port

LASTING = ("/dev/serial/by-id/", "/dev/serial/by-path/")
"""Names that stay with the adapter, or with the socket it is plugged into."""
TTYS = Path("/sys/class/tty")
PSEUDO = "/dev/pts/"
"""Emulated grippers are there; the kernel does not list them."""


def check_serial_port(port: str) -> Iterator[CheckResult]:
    """The port; nothing is opened."""
    path = Path(port)
    if not _is_device(path) or not os.access(port, os.R_OK | os.W_OK):
        why, _, action = serial_port.what_is_wrong(port).partition("; ")
        yield problem("port", f"{port}: {why}", action or "log out and in again after `usermod -aG dialout USER`")
        return
    target = os.path.realpath(port)
    if not target.startswith(PSEUDO) and not (TTYS / Path(target).name).exists():
        yield problem("port", f"{port}: it is no serial port", "name one of `ls /dev/serial/by-id`")
        return
    if path.is_symlink():
        yield ok("port", f"{port} is {target}, readable and writable")
    elif port.startswith("/dev/tty") and not port.startswith(LASTING):
        yield note("port", f"{port} may name another adapter tomorrow", "name it by one of `ls /dev/serial/by-id`")
    else:
        yield ok("port", f"{port}, readable and writable")
    yield adapter(serial_port.latency_timer_ms(port))


def _is_device(path: Path) -> bool:
    try:
        return path.is_char_device()
    except OSError:  # a folder on the way that is not for this user
        return False


def adapter(timer_ms: int | None) -> CheckResult:
    """The latency timer of an FTDI adapter: each question waits for it."""
    if timer_ms is None:
        return ok("adapter", "not an FTDI one, no latency timer to set")
    if timer_ms > 1:
        return note(
            "adapter",
            f"FTDI latency timer {timer_ms} ms; slipguard asks for 1 ms when it opens the port",
            "`sudo slipguard install` puts 60-slipguard.rules in place, so that other programs get it as well",
        )
    return ok("adapter", "FTDI latency timer 1 ms")
