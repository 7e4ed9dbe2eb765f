"""The rendering process never outlives its sensor or its parent, and ignores Ctrl-C."""

from __future__ import annotations

import asyncio
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from slipguard.devices import DriverContext
from slipguard.errors import DeviceError, DeviceLost
from slipguard.sim.world import World
from slipguard_drivers.digit.fake import FakeSensor
from slipguard_drivers.digit.fake_renderer import ProcessRenderer

PARENT = """
import asyncio
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)  # a gate run in the background ignores it, and hands that down
from slipguard.devices import DriverContext
from slipguard.sim.world import World
from slipguard_drivers.digit.fake import FakeSensor

async def main():
    sensor = FakeSensor(FakeSensor.Settings(stall_ms=5000), DriverContext("left", World()))
    try:
        await sensor.open()
        print(sensor._renderer._child.pid, flush=True)
        while True:
            await sensor.next_frame()
    finally:
        await sensor.close()

asyncio.run(main())
"""


def new_sensor() -> FakeSensor:
    """One that gives a busy machine time for its first image."""
    return FakeSensor(FakeSensor.Settings(stall_ms=5000), DriverContext("left", World()))


def child_of(sensor: FakeSensor) -> int:
    renderer = sensor._renderer
    assert isinstance(renderer, ProcessRenderer)
    assert renderer._child is not None
    return renderer._child.pid


def runs(pid: int) -> bool:
    """Whether a process is there and not just waiting to be collected."""
    try:
        return "\nState:\tZ" not in Path(f"/proc/{pid}/status").read_text()
    except (FileNotFoundError, ProcessLookupError):  # the latter where it ends between opening and reading
        return False


def gone(pid: int, within_s: float) -> bool:
    ends_s = time.monotonic() + within_s
    while runs(pid):
        if time.monotonic() > ends_s:
            return False
        threading.Event().wait(0.005)
    return True


def descriptors() -> set[str]:
    return {
        os.readlink(f"/proc/self/fd/{fd}")
        for fd in os.listdir("/proc/self/fd")
        if os.path.exists(f"/proc/self/fd/{fd}")
    }


async def test_closing_ends_the_process_and_leaves_nothing_open() -> None:
    before = descriptors()
    sensor = new_sensor()
    await sensor.open()
    pid = child_of(sensor)
    assert os.getpriority(os.PRIO_PROCESS, pid) > 0
    await sensor.next_frame()
    await sensor.close()
    assert not runs(pid)
    assert not any("slipguard" in name for name in descriptors() - before)


async def test_closing_ends_a_process_that_hangs() -> None:
    sensor = new_sensor()
    await sensor.open()
    pid = child_of(sensor)
    os.kill(pid, signal.SIGSTOP)
    try:
        await sensor.close()
        assert not runs(pid)
    finally:
        if runs(pid):
            os.kill(pid, signal.SIGCONT)


async def test_a_process_that_dies_is_a_lost_sensor_and_open_starts_another() -> None:
    sensor = new_sensor()
    await sensor.open()
    first = child_of(sensor)
    os.kill(first, signal.SIGKILL)
    with pytest.raises(DeviceLost, match="rendering process"):
        async with asyncio.timeout(5.0):
            await _frames_until_lost(sensor)
    await sensor.open()
    assert child_of(sensor) != first
    await sensor.next_frame()
    await sensor.close()


@pytest.mark.parametrize("ending", [signal.SIGINT, signal.SIGKILL], ids=["Ctrl-C", "kill"])
def test_it_does_not_outlive_its_parent(ending: signal.Signals) -> None:
    with subprocess.Popen(
        [sys.executable, "-W", "error", "-c", PARENT], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as parent:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        os.kill(pid, signal.SIGINT)
        assert not gone(pid, within_s=0.1), "a Ctrl-C is for the parent alone"
        parent.send_signal(ending)
        _, complaints = parent.communicate()
    assert gone(pid, within_s=5.0)
    if ending == signal.SIGINT:
        assert "ResourceWarning" not in complaints
        assert "draw_" not in complaints
        assert complaints.strip().endswith("KeyboardInterrupt")
    else:
        assert complaints == ""


async def _frames_until_lost(sensor: FakeSensor) -> None:
    while True:
        try:
            await sensor.next_frame()
        except DeviceLost:
            raise
        except DeviceError:
            continue
