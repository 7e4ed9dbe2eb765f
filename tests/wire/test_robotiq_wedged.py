"""A wedged USB adapter: opening or closing its port blocks for many seconds. The event loop must go on meanwhile."""

from __future__ import annotations

import asyncio
import os
import termios
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from slipguard.devices import DriverContext
from slipguard.errors import DeviceLost
from slipguard_drivers.robotiq import byte_line
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_emulators.robotiq.emulator import RobotiqEmulator

WEDGED_S = 5.0
"""How long the port blocks at most, if the test does not end that."""


class WedgedAdapter:
    """Blocks `os.open` and `os.close` of one port, in whichever thread they are called."""

    def __init__(self, port: str, monkeypatch: pytest.MonkeyPatch) -> None:
        self.wedged, self.calls = False, 0
        self._port, self._fds = port, set[int]()
        self._answers = threading.Event()
        self._open, self._close = os.open, os.close
        monkeypatch.setattr(os, "open", self.open)
        monkeypatch.setattr(os, "close", self.close)
        monkeypatch.setattr(byte_line, "BLOCKED_S", 0.05)

    def wedge(self) -> None:
        self.wedged, self.calls = True, 0
        self._answers.clear()

    def mend(self) -> None:
        self.wedged = False
        self._answers.set()

    @property
    def is_open(self) -> bool:
        return bool(self._fds)

    def open(self, path: object, *args: object, **options: object) -> int:
        if path == self._port:
            self._block()
        fd = self._open(path, *args, **options)  # type: ignore[arg-type]
        if path == self._port:
            self._fds.add(fd)
        return fd

    def close(self, fd: int) -> None:
        if fd in self._fds:
            self._block()
            self._fds.discard(fd)
        self._close(fd)

    def _block(self) -> None:
        self.calls += 1
        if self.wedged:
            self._answers.wait(WEDGED_S)


@pytest.fixture
def adapter(emulator: RobotiqEmulator, monkeypatch: pytest.MonkeyPatch) -> Iterator[WedgedAdapter]:
    adapter = WedgedAdapter(emulator.address, monkeypatch)
    yield adapter
    adapter.mend()


class Ticks:
    """Counts the cycles of the event loop."""

    def __init__(self) -> None:
        self.count = 0
        self.task = asyncio.create_task(self._run(), name="ticks")

    async def _run(self) -> None:
        while True:
            self.count += 1
            await asyncio.sleep(0.001)

    async def stop(self) -> int:
        self.task.cancel()
        await asyncio.wait([self.task])
        return self.count


def driver(emulator: RobotiqEmulator) -> RobotiqGripper:
    return RobotiqGripper(RobotiqGripper.Settings(port=emulator.address, timeout_ms=300.0), DriverContext("gripper"))


async def closed(adapter: WedgedAdapter, *, after_calls: int = 0) -> None:
    """Wait until the port is closed, after at least so many calls."""
    for _ in range(500):
        if adapter.calls >= after_calls and not adapter.is_open:
            return
        await asyncio.sleep(0.01)
    pytest.fail("the port stays open")


async def test_an_open_that_blocks_does_not_block_the_loop(emulator: RobotiqEmulator, adapter: WedgedAdapter) -> None:
    gripper = driver(emulator)
    adapter.wedge()
    ticks = Ticks()
    for _ in range(3):
        with pytest.raises(DeviceLost, match="does not respond"):
            await gripper.open()
        await gripper.close()
    assert await ticks.stop() >= 3
    assert adapter.calls == 1, "one thread waits for the adapter, however often it is tried"
    adapter.mend()
    await gripper.open()
    assert (await gripper.state()).active
    await gripper.close()
    await closed(adapter)


async def test_a_port_that_opens_too_late_is_closed_again(emulator: RobotiqEmulator, adapter: WedgedAdapter) -> None:
    gripper = driver(emulator)
    adapter.wedge()
    with pytest.raises(DeviceLost):
        await gripper.open()
    opening = asyncio.create_task(gripper.open())
    await asyncio.sleep(0)
    opening.cancel()
    await asyncio.wait([opening])
    adapter.mend()
    await closed(adapter, after_calls=2)


async def test_a_close_that_blocks_does_not_block_the_loop(emulator: RobotiqEmulator, adapter: WedgedAdapter) -> None:
    gripper = driver(emulator)
    await gripper.open()
    adapter.wedge()
    ticks = Ticks()
    await gripper.close()
    with pytest.raises(DeviceLost, match="does not respond"):
        await gripper.open()
    assert await ticks.stop() >= 3
    assert adapter.calls == 1
    adapter.mend()
    await gripper.open()
    assert (await gripper.state()).active
    await gripper.close()
    await closed(adapter)


async def test_an_adapter_unplugged_and_wedged_is_lost_at_once(
    emulator: RobotiqEmulator, adapter: WedgedAdapter
) -> None:
    gripper = driver(emulator)
    await gripper.open()
    adapter.wedge()
    ticks = Ticks()
    emulator.control("fault unplug")
    with pytest.raises(DeviceLost):
        await gripper.state()
    with pytest.raises(DeviceLost):
        await gripper.open()
    assert await ticks.stop() >= 3
    adapter.mend()
    emulator.control("clear unplug")
    await gripper.close()
    await closed(adapter)


def test_the_port_is_raw_exclusive_and_at_115200(tmp_path: Path) -> None:
    ours, theirs = os.openpty()
    port = os.ttyname(theirs)
    os.close(theirs)
    opened = byte_line.open_port(port)
    iflag, oflag, cflag, lflag, ispeed, ospeed, _ = termios.tcgetattr(opened.fileno())
    assert (ispeed, ospeed) == (termios.B115200, termios.B115200)
    assert cflag & (termios.CSIZE | termios.PARENB | termios.CSTOPB | termios.CRTSCTS) == termios.CS8
    assert lflag & (termios.ICANON | termios.ECHO | termios.ISIG) == 0
    assert iflag & (termios.IXON | termios.IXOFF | termios.ICRNL | termios.ISTRIP) == 0
    assert oflag & termios.OPOST == 0
    with pytest.raises(BlockingIOError):
        os.read(opened.fileno(), 1)
    with pytest.raises(OSError, match="unavailable"):
        byte_line.open_port(port)
    byte_line.close_port(opened)
    os.close(ours)
    (tmp_path / "file").touch()
    with pytest.raises(OSError, match="Could not configure port"):
        byte_line.open_port(str(tmp_path / "file"))
