"""The serial port as Linux shows it: why it cannot be opened, which program holds it, how slow its adapter is.

With the checks of `slipguard doctor`; those do not open the port.
"""

from __future__ import annotations

import array
import contextlib
import fcntl
import grp
import os
import termios
from collections.abc import Iterable, Iterator
from pathlib import Path

from slipguard.diagnosis import CheckResult, note, ok, problem

PROC = Path("/proc")
SYS = Path("/sys")
TTYS = Path("/sys/class/tty")
PSEUDO_TERMINALS = "/dev/pts/"
"""Emulated grippers; the kernel does not list them as serial ports."""
LASTING_NAMES = ("/dev/serial/by-id/", "/dev/serial/by-path/")
"""Names that stay with the adapter, or with the USB socket it is plugged into."""
LATENCY_TIMER_MAX_MS = 1
TIOCGSERIAL, TIOCSSERIAL = 0x541E, 0x541F
SERIAL_STRUCT_WORDS = 32
"""struct serial_struct has 72 bytes; the rest is reserve."""
FLAGS_WORD = 4
ASYNC_LOW_LATENCY = 1 << 13


def why_not_usable(port: str) -> str:
    """Return why a port cannot be opened, and what to do. May inspect every process, which takes a while."""
    return device_fault(port) or holders_text(other_holders(port))


def device_fault(port: str) -> str | None:
    """Return the fault of the device file itself; None if there is none."""
    path = Path(port)
    if not path.exists():
        if path.is_symlink():
            return "its adapter is unplugged (the link has no target); plug it in again"
        return "no such device; plug the adapter in, `ls /dev/serial/by-id` lists the connected ones"
    if not path.is_char_device():
        return "not a serial port; use one of `ls /dev/serial/by-id`"
    if not os.access(port, os.R_OK | os.W_OK):
        return f"access is denied; add the user to the group {_group(path)}"
    return None


def holders_text(processes: Iterable[int]) -> str:
    """Return which programs hold a port, and what to do. processes: empty if they are hidden from this user."""
    named = [f"{_name(process)} (process {process})" for process in sorted(processes)]
    if named:
        return f"{' and '.join(named)} has it open; end that program, slipguard must be the only one on the line"
    return "not a serial port, or another program has it open; `sudo fuser` shows which"


def other_holders(port: str) -> set[int]:
    """Return the other processes that have a port open, as far as this user may see them. Takes a while.

    Open files are visible for the user's own processes, and for root for all; locks are visible for all. Under systemd
    with ProtectProc=invisible, a program of another user that takes no lock is not found.
    """
    try:
        wanted = os.stat(port)
    except OSError:
        return set()
    return {*_lockers(wanted), *(process for process in _all_processes() if _has_open(process, wanted))} - {os.getpid()}


def latency_timer_ms(port: str) -> int | None:
    """Return how long the USB adapter keeps received bytes before it passes them on; None if it does not say."""
    with contextlib.suppress(OSError, ValueError):
        name = Path(os.path.realpath(port)).name
        return int((SYS / "class" / "tty" / name / "device" / "latency_timer").read_text())
    return None


def lock_out_others(fd: int) -> None:
    """Prevent all other programs, except root's, from opening the port, even those that take no lock."""
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCEXCL)


def request_low_latency(fd: int) -> None:
    """Ask the adapter's driver for low latency: an FTDI's timer becomes 1 ms. Other drivers ignore it."""
    words = array.array("i", [0] * SERIAL_STRUCT_WORDS)
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, TIOCGSERIAL, words)
        words[FLAGS_WORD] |= ASYNC_LOW_LATENCY
        fcntl.ioctl(fd, TIOCSSERIAL, words)


def slow_adapter(port: str) -> str | None:
    """Return what to do about an adapter with a long latency timer; None if there is no problem."""
    timer_ms = latency_timer_ms(port)
    if timer_ms is None or timer_ms <= LATENCY_TIMER_MAX_MS:
        return None
    return (
        f"the adapter's latency timer is {timer_ms} ms (at most {LATENCY_TIMER_MAX_MS} ms is fast enough); "
        "`sudo slipguard install` adds 60-slipguard.rules, which sets it when the adapter is plugged in again"
    )


def check_serial_port(port: str) -> Iterator[CheckResult]:
    """Check the device file, access and adapter."""
    path = Path(port)
    if not _is_device(path) or not os.access(port, os.R_OK | os.W_OK):
        reason, _, action = why_not_usable(port).partition("; ")
        yield problem("port", f"{port}: {reason}", action or "log out and in again after `usermod -aG dialout USER`")
        return
    target = os.path.realpath(port)
    if not target.startswith(PSEUDO_TERMINALS) and not (TTYS / Path(target).name).exists():
        yield problem("port", f"{port}: not a serial port", "use one of `ls /dev/serial/by-id`")
        return
    if path.is_symlink():
        yield ok("port", f"{port} is {target}, readable and writable")
    elif port.startswith("/dev/tty") and not port.startswith(LASTING_NAMES):
        yield note("port", f"{port} may be another adapter after a restart", "use one of `ls /dev/serial/by-id`")
    else:
        yield ok("port", f"{port}, readable and writable")
    yield check_adapter(latency_timer_ms(port))


def check_adapter(timer_ms: int | None) -> CheckResult:
    """Check the latency timer of an FTDI adapter: every request waits for it."""
    if timer_ms is None:
        return ok("adapter", "not FTDI, no latency timer to set")
    if timer_ms > LATENCY_TIMER_MAX_MS:
        return note(
            "adapter",
            f"FTDI latency timer {timer_ms} ms; slipguard requests 1 ms when it opens the port",
            "`sudo slipguard install` adds 60-slipguard.rules, so that other programs get it as well",
        )
    return ok("adapter", "FTDI latency timer 1 ms")


def _is_device(path: Path) -> bool:
    try:
        return path.is_char_device()
    except OSError:  # a folder of the path is not readable for this user
        return False


def _lockers(wanted: os.stat_result) -> Iterator[int]:
    """Yield the processes with a lock on the file; every user may read this list."""
    place = f"{os.major(wanted.st_dev):02x}:{os.minor(wanted.st_dev):02x}:{wanted.st_ino}"
    with contextlib.suppress(OSError):
        for line in (PROC / "locks").read_text().splitlines():
            fields = line.replace("->", " ").split()
            if place in fields and fields[4].isdecimal():
                yield int(fields[4])


def _all_processes() -> Iterator[int]:
    with os.scandir(PROC) as entries:
        yield from [int(entry.name) for entry in entries if entry.name.isdecimal()]


def _has_open(process: int, wanted: os.stat_result) -> bool:
    """Return whether a process has the file open; False if it may not be inspected, or has ended."""
    with contextlib.suppress(OSError), os.scandir(PROC / str(process) / "fd") as entries:
        for entry in entries:
            with contextlib.suppress(OSError):
                found = os.stat(entry.path)
                if (found.st_ino, found.st_dev) == (wanted.st_ino, wanted.st_dev):
                    return True
    return False


def _name(process: int) -> str:
    with contextlib.suppress(OSError):
        return (PROC / str(process) / "comm").read_text().strip()
    return "another program"


def _group(path: Path) -> str:
    """Return the group that may use the port; dialout if it has no name."""
    with contextlib.suppress(OSError, KeyError):
        return grp.getgrgid(path.stat().st_gid).gr_name
    return "dialout"
