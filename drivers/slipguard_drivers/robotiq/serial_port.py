"""The serial port as the system shows it: who has it, why it cannot be opened, how long its adapter keeps an answer."""

from __future__ import annotations

import array
import contextlib
import fcntl
import grp
import os
import termios
from collections.abc import Iterator
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
    """Why a port cannot be opened, and what to do, in one line."""
    path = Path(port)
    if not path.exists():
        if path.is_symlink():
            return "its adapter is unplugged (the link leads nowhere); plug it in again"
        return "there is no such device; plug the adapter in, `ls /dev/serial/by-id` shows those there are"
    if not path.is_char_device():
        return "it is no serial port; name one of `ls /dev/serial/by-id`"
    if not os.access(port, os.R_OK | os.W_OK):
        return f"access is denied; the user must be in the group {_group(path)}"
    others = holders(port)
    if others:
        return f"{' and '.join(others)} has it open; end that, slipguard must be alone on the line"
    return "it is no serial port, or another program has it open; `fuser` tells which to its owner"


def holders(port: str) -> list[str]:
    """Other processes that have a port open, as "minicom (process 1234)"; those of other users only if they lock it."""
    try:
        wanted = os.stat(port)
    except OSError:
        return []
    found = sorted(({*_lockers(wanted), *_openers(wanted)}) - {os.getpid()})
    return [f"{_name(process)} (process {process})" for process in found]


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
        f"the adapter keeps each answer for up to {timer_ms} ms; install systemd/60-slipguard.rules and plug it in "
        "again, its latency timer is 1 ms then"
    )


def _lockers(wanted: os.stat_result) -> Iterator[int]:
    """Processes with a lock on the file; everybody may read this list."""
    place = f"{os.major(wanted.st_dev):02x}:{os.minor(wanted.st_dev):02x}:{wanted.st_ino}"
    with contextlib.suppress(OSError):
        for line in (PROC / "locks").read_text().splitlines():
            words = line.replace("->", " ").split()
            if place in words and words[4].isdecimal():
                yield int(words[4])


def _openers(wanted: os.stat_result) -> Iterator[int]:
    """Processes that have the file open, as far as we may see."""
    for process in PROC.iterdir():
        if not process.name.isdecimal():
            continue
        with contextlib.suppress(OSError):
            for one in (process / "fd").iterdir():
                with contextlib.suppress(OSError):
                    seen = one.stat()
                    if (seen.st_ino, seen.st_dev) == (wanted.st_ino, wanted.st_dev):
                        yield int(process.name)


def _name(process: int) -> str:
    with contextlib.suppress(OSError):
        return (PROC / str(process) / "comm").read_text().strip()
    return "another program"


def _group(path: Path) -> str:
    """The group that may use the port; dialout where it has no name."""
    with contextlib.suppress(OSError, KeyError):
        return grp.getgrgid(path.stat().st_gid).gr_name
    return "dialout"
