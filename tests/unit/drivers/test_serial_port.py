"""System information on a serial port: which program has it open, and its adapter's latency timer."""

from __future__ import annotations

import array
import fcntl
import os
import termios
from collections.abc import Iterator
from pathlib import Path

import pytest

from slipguard_drivers.robotiq import serial_port


@pytest.fixture
def terminal() -> Iterator[tuple[int, str]]:
    ours, theirs = os.openpty()
    yield theirs, os.ttyname(theirs)
    os.close(ours)
    os.close(theirs)


def test_low_latency_is_one_flag_and_the_rest_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    """struct serial_struct: type, line, port, irq, flags, ..."""
    asked: list[tuple[int, list[int]]] = []

    def ioctl(fd: int, request: int, words: array.array[int]) -> int:
        if request == serial_port.TIOCGSERIAL:
            words[:5] = array.array("i", [1, 2, 3, 4, 0x40])
        asked.append((request, list(words[:5])))
        return 0

    monkeypatch.setattr(fcntl, "ioctl", ioctl)
    serial_port.request_low_latency(7)
    assert [request for request, _ in asked] == [0x541E, 0x541F]
    assert asked[1][1] == [1, 2, 3, 4, 0x40 | 0x2000]
    assert array.array("i", [0] * serial_port.SERIAL_STRUCT_WORDS).itemsize * serial_port.SERIAL_STRUCT_WORDS >= 72


def test_a_port_without_low_latency_stays_unchanged(terminal: tuple[int, str]) -> None:
    serial_port.request_low_latency(terminal[0])
    assert serial_port.latency_timer_ms(terminal[1]) is None
    assert serial_port.slow_adapter(terminal[1]) is None


def test_claiming_sets_exclusive_use(terminal: tuple[int, str]) -> None:
    """Opening it again is then refused to everybody but root."""
    serial_port.lock_out_others(terminal[0])
    tiocgexcl = 0x80045440
    flag = array.array("i", [0])
    fcntl.ioctl(terminal[0], tiocgexcl, flag)
    assert flag[0] == 1
    fcntl.ioctl(terminal[0], termios.TIOCNXCL)


def test_our_own_process_is_not_a_holder(terminal: tuple[int, str]) -> None:
    assert serial_port.other_holders(terminal[1]) == set()
    assert serial_port.other_holders("/dev/no_such_port") == set()


def test_a_process_with_a_lock_is_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Another user's open files cannot be seen, but his locks can."""
    port = tmp_path / "tty"
    port.touch()
    seen = port.stat()
    place = f"{os.major(seen.st_dev):02x}:{os.minor(seen.st_dev):02x}:{seen.st_ino}"
    proc = tmp_path / "proc"
    (proc / "4711").mkdir(parents=True)
    (proc / "4711" / "comm").write_text("minicom\n")
    (proc / "locks").write_text(
        f"1: POSIX  ADVISORY  WRITE 99 00:01:5 0 EOF\n2: FLOCK  ADVISORY  WRITE 4711 {place} 0 EOF\n"
    )
    monkeypatch.setattr(serial_port, "PROC", proc)
    assert serial_port.other_holders(str(port)) == {4711}
    assert serial_port.holders_text({4711}).startswith("minicom (process 4711) has it open; ")


def test_visible_open_files_are_found(
    terminal: tuple[int, str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for process in (4711, 4712):
        (tmp_path / str(process) / "fd").mkdir(parents=True)
    (tmp_path / "4711" / "fd" / "3").symlink_to(terminal[1])
    (tmp_path / "4712" / "fd" / "3").symlink_to("/dev/null")
    (tmp_path / "4713").mkdir()
    monkeypatch.setattr(serial_port, "PROC", tmp_path)
    assert serial_port.other_holders(terminal[1]) == {4711}
