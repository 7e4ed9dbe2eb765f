"""A stop at any moment ends the tasks that own devices in time, even if a driver or a library swallows it."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest
import structlog
from loop_cell import Cell
from structlog.testing import capture_logs

from slipguard.config import parse_config
from slipguard.daemon import lifecycle
from slipguard.daemon import run as root
from slipguard.daemon.lifecycle import CANCEL_AGAIN_S, EXIT_S, FLUSH_S, exit_if_stuck
from slipguard.daemon.loop.actuator import Actuator
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.devices import DriverContext, Frame
from slipguard.errors import DeviceLost, DeviceTimeout
from slipguard.sim.world import World, WorldSettings
from slipguard_drivers.robotiq.gripper import RobotiqGripper

ROTATIONS = range(16)


async def swallowing() -> None:
    """As `asyncio.wait_for` until Python 3.12, where the result arrives in the same cycle of the event loop."""
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.sleep(0)


class Careless:
    """A device and a sensor that swallow a cancellation wherever they wait. there: whether it opens."""

    serial = "D1"
    remarks = ()

    def __init__(self, there: bool) -> None:
        self.there = there

    async def open(self) -> None:
        await swallowing()
        if not self.there:
            raise DeviceLost("motor: unplugged; plug it in")

    async def state(self) -> int:
        await swallowing()
        return 1

    async def next_frame(self) -> Frame:
        await swallowing()
        raise DeviceTimeout("motor: no frame")

    async def stop(self) -> None:
        await swallowing()

    async def close(self) -> None:
        await swallowing()


def ended_when_cancelled_at(rotation: int, make: Callable[[], Coroutine[Any, Any, None]]) -> bool:
    async def main() -> bool:
        task = asyncio.create_task(make())
        for _ in range(rotation):
            await asyncio.sleep(0)
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=5.0)
        return bool(done)

    return run_virtual(main())


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_a_device_that_swallows_a_cancellation_is_closed(rotation: int, there: bool) -> None:
    def driven() -> Coroutine[Any, Any, None]:
        device = Careless(there)
        actuator: Actuator[int] = Actuator("motor", device, 0.02, 0.5, lambda: None, lambda line: None)
        actuator.command(device.stop)
        return actuator.run()

    assert ended_when_cancelled_at(rotation, driven)


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_a_sensor_that_swallows_a_cancellation_is_closed(rotation: int, there: bool) -> None:
    def sensed() -> Coroutine[Any, Any, None]:
        finger = Cell().service.fingers["left"]
        finger.capture.sensor = Careless(there)  # type: ignore[assignment]
        return finger.run()

    assert ended_when_cancelled_at(rotation, sensed)


@pytest.mark.parametrize("rotation", range(10))
async def test_a_stop_in_the_middle_of_an_attempt_at_a_port_that_is_absent(rotation: int, tmp_path: Path) -> None:
    settings = RobotiqGripper.Settings(port=str(tmp_path / "ttyAbsent"))
    gripper = RobotiqGripper(settings, DriverContext("gripper"))
    running = asyncio.create_task(Actuator("gripper", gripper, 0.025, 0.5, lambda: None, lambda line: None).run())
    for _ in range(rotation):
        await asyncio.sleep(0)
    running.cancel()
    done, _ = await asyncio.wait([running], timeout=5.0)
    running.cancel()
    assert done


async def one_that_stays() -> None:
    """Go on after the request to end."""
    try:
        await asyncio.Event().wait()
    except asyncio.CancelledError:
        await asyncio.Event().wait()


def test_a_task_that_ignores_cancellation_is_named_and_cancelled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def idle(*handlers: object) -> None:  # the real API would be disturbed in its last responses
        await asyncio.Event().wait()

    monkeypatch.setattr(lifecycle, "CANCEL_AGAIN_S", 0.05)

    async def extra_task_body(service: Any) -> None:
        asyncio.get_running_loop().call_later(0.01, os.kill, os.getpid(), signal.SIGTERM)
        await one_that_stays()

    async def main() -> None:
        async with asyncio.timeout(30.0):
            config = parse_config({"state": {"directory": str(tmp_path)}}, where="test", sim=True)
            await root.run(config, lambda _: idle, world=World(WorldSettings(), seed=0), extra_task=extra_task_body)

    structlog.reset_defaults()
    with capture_logs() as reported:
        asyncio.run(main())
    (line,) = [line for line in reported if "cancelled again" in line["event"]]
    assert "extra" in line["tasks"]
    assert reported[-1]["event"] == "slipguard stops; the grip stays as it is"


async def test_a_hanging_process_exits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lifecycle, "EXIT_S", 0.05)
    left, codes = threading.Event(), list[int]()

    def leave(code: int) -> None:
        codes.append(code)
        left.set()

    structlog.reset_defaults()
    with capture_logs() as reported:
        exit_if_stuck(leave)
        assert left.wait(30.0), "the loop stands still meanwhile"
    assert codes == [1]
    assert "process exits" in reported[-1]["event"]


async def test_without_a_thread_for_it_the_kernel_ends_a_hanging_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    asyncio.get_running_loop().add_signal_handler(signal.SIGALRM, lambda: None)
    monkeypatch.setattr(threading.Timer, "start", refuse)
    try:
        exit_if_stuck()
        assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    finally:
        remaining_s = signal.alarm(0)
    assert 0 < remaining_s <= EXIT_S


def test_systemd_waits_longer() -> None:
    unit = (Path(__file__).parents[2] / "systemd" / "slipguard.service").read_text()
    stop_s = next(float(line.partition("=")[2]) for line in unit.splitlines() if line.startswith("TimeoutStopSec="))
    assert CANCEL_AGAIN_S < EXIT_S < EXIT_S + FLUSH_S < stop_s
