"""The serial port as the system shows it: who has it, why it cannot be opened, how long its adapter keeps an answer."""

from __future__ import annotations

import array
import contextlib
import fcntl
import grp
import os
import termios
from collections.abc import Iterable, Iterator
from pathlib import Path

PROC = Path("/proc")
SYS = Path("/sys")
FTDI_DEFAULT_MS = 16
TIOCGSERIAL, TIOCSSERIAL = 0x541E, 0x541F
SERIAL_STRUCT_WORDS = 32
"""struct serial_struct is 72 bytes; the rest is slack."""
FLAGS_WORD = 4
ASYNC_LOW_LATENCY = 1 << 13


def what_is_wrong(port: str) -> str:
    """Why a port cannot be opened, and what to do, in one line. May look at every process: that takes a while."""
    return out_of_order(port) or in_use(others(port))


def out_of_order(port: str) -> str | None:
    """What is wrong with a port whoever else uses it; None where nothing is."""
    path = Path(port)
    if not path.exists():
        if path.is_symlink():
            return "its adapter is unplugged (the link leads nowhere); plug it in again"
        return "there is no such device; plug the adapter in, `ls /dev/serial/by-id` shows those there are"
    if not path.is_char_device():
        return "it is no serial port; name one of `ls /dev/serial/by-id`"
    if not os.access(port, os.R_OK | os.W_OK):
        return f"access is denied; the user must be in the group {_group(path)}"
    return None


def in_use(processes: Iterable[int]) -> str:
    """Who has a port that we cannot have, and what to do. processes: those found; empty where they hide."""
    named = [f"{_name(process)} (process {process})" for process in sorted(processes)]
    if named:
        return f"{' and '.join(named)} has it open; end that, slipguard must be alone on the line"
    return "it is no serial port, or another program has it open; `fuser` tells which to its owner"


def others(port: str, among: Iterable[int] | None = None) -> set[int]:
    """Other processes that have a port open, as far as we may see. among: look at no others' open files.

    Open files are seen of one's own user's processes, by root of all; locks are seen of everybody. Under systemd with
    ProtectProc=invisible even root's are hidden: a program of another user that asks for no lock is then not found.
    Without `among` every process is looked at, which takes a while: not for the event loop.
    """
    try:
        wanted = os.stat(port)
    except OSError:
        return set()
    processes = _all_processes() if among is None else among
    return {*_lockers(wanted), *(one for one in processes if _has_open(one, wanted))} - {os.getpid()}


def latency_timer_ms(port: str) -> int | None:
    """How long the USB adapter keeps an answer before it hands it over; None where it is none that says."""
    with contextlib.suppress(OSError, ValueError):
        name = Path(os.path.realpath(port)).name
        return int((SYS / "class" / "tty" / name / "device" / "latency_timer").read_text())
    return None


def claim(fd: int) -> None:
    """Nobody else may open the port from now on, programs that ask for no lock included (root still may)."""
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, termios.TIOCEXCL)


def hurry(fd: int) -> None:
    """Ask the adapter's driver for low latency: an FTDI's timer becomes 1 ms. Others do not know it, and need not."""
    words = array.array("i", [0] * SERIAL_STRUCT_WORDS)
    with contextlib.suppress(OSError):
        fcntl.ioctl(fd, TIOCGSERIAL, words)
        words[FLAGS_WORD] |= ASYNC_LOW_LATENCY
        fcntl.ioctl(fd, TIOCSSERIAL, words)


def slow_adapter(port: str) -> str | None:
    """What to do about an adapter that keeps answers for longer than a millisecond; None where there is none."""
    timer_ms = latency_timer_ms(port)
    if timer_ms is None or timer_ms <= 1:
        return None
    return (
        f"the adapter keeps each answer for up to {timer_ms} ms; `sudo slipguard install` puts 60-slipguard.rules in "
        "place; plug it in again, its latency timer is 1 ms then"
    )


def _lockers(wanted: os.stat_result) -> Iterator[int]:
    """Processes with a lock on the file; everybody may read this list."""
    place = f"{os.major(wanted.st_dev):02x}:{os.minor(wanted.st_dev):02x}:{wanted.st_ino}"
    with contextlib.suppress(OSError):
        for line in (PROC / "locks").read_text().splitlines():
            words = line.replace("->", " ").split()
            if place in words and words[4].isdecimal():
                yield int(words[4])


def _all_processes() -> Iterator[int]:
    with os.scandir(PROC) as entries:
        yield from [int(entry.name) for entry in entries if entry.name.isdecimal()]


def _has_open(process: int, wanted: os.stat_result) -> bool:
    """Whether a process has the file open; False where it may not be looked at, or has ended."""
    with contextlib.suppress(OSError), os.scandir(PROC / str(process) / "fd") as entries:
        for entry in entries:
            with contextlib.suppress(OSError):
                seen = os.stat(entry.path)
                if (seen.st_ino, seen.st_dev) == (wanted.st_ino, wanted.st_dev):
                    return True
    return False


def _name(process: int) -> str:
    with contextlib.suppress(OSError):
        return (PROC / str(process) / "comm").read_text().strip()
    return "another program"


def _group(path: Path) -> str:
    """The group that may use the port; dialout where it has no name."""
    with contextlib.suppress(OSError, KeyError):
        return grp.getgrgid(path.stat().st_gid).gr_name
    return "dialout"
