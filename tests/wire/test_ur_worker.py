"""The arm driver when its loop, its worker or its controller goes astray: the arm must stop, and nothing may hang."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import AsyncIterator

import pytest
from ur_emulator import MOVE_L, STOP_L, WATCHDOG, UrEmulator

from slipguard.devices import DriverContext
from slipguard.errors import DeviceError, DeviceLost
from slipguard_drivers.ur5.arm import Ur5Arm

HOST = "127.0.0.31"


@pytest.fixture
async def controller() -> AsyncIterator[UrEmulator]:
    controller = UrEmulator(HOST)
    await controller.start()
    yield controller
    await controller.kill()


@pytest.fixture
async def arm(controller: UrEmulator) -> AsyncIterator[Ur5Arm]:
    arm = Ur5Arm(Ur5Arm.Settings(host=HOST), DriverContext("arm"))
    await arm.open()
    yield arm
    await arm.close()


def worker_of(arm: Ur5Arm) -> int:
    assert arm._link._child is not None
    return arm._link._child.pid


async def error_of(arm: Ur5Arm) -> DeviceError:
    async with asyncio.timeout(4.0):
        while True:
            try:
                await arm.state()
            except DeviceLost as error:
                return error
            except DeviceError:
                pass
            await asyncio.sleep(0.01)


async def rests(controller: UrEmulator) -> bool:
    for _ in range(100):
        if controller.point.speed_m_s == 0.0:
            return True
        await asyncio.sleep(0.01)
    return False


async def under_way(controller: UrEmulator, arm: Ur5Arm) -> None:
    await arm.lift(400.0, 100.0)
    for _ in range(200):
        if (await arm.state()).moving:
            return
        await asyncio.sleep(0.01)
    pytest.fail("it does not move")


async def test_the_watchdog_is_armed_before_anything_moves(controller: UrEmulator, arm: Ur5Arm) -> None:
    await under_way(controller, arm)
    assert controller.commands.index(WATCHDOG) < controller.commands.index(MOVE_L)


async def test_a_stop_is_seen_by_the_controller(controller: UrEmulator, arm: Ur5Arm) -> None:
    await under_way(controller, arm)
    await arm.stop()
    assert controller.commands[-1] == STOP_L
    assert await rests(controller)


async def test_a_new_lift_replaces_the_one_under_way(controller: UrEmulator, arm: Ur5Arm) -> None:
    await under_way(controller, arm)
    await arm.lift(-5.0, 50.0)
    assert controller.commands[-2:] == [STOP_L, MOVE_L]


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["dies", "hangs"])
async def test_a_worker_that_is_gone_stops_the_arm(controller: UrEmulator, arm: Ur5Arm, how: signal.Signals) -> None:
    await under_way(controller, arm)
    os.kill(worker_of(arm), how)
    assert await rests(controller)
    await error_of(arm)
    await arm.open()
    assert not (await arm.state()).moving


async def test_a_loop_that_hangs_stops_the_arm(controller: UrEmulator, arm: Ur5Arm) -> None:
    await under_way(controller, arm)
    before = worker_of(arm)
    threading.Event().wait(0.6)  # the emulator hangs with the loop: its watchdog acts when it goes on
    assert await rests(controller)
    assert "script" in str(await error_of(arm))
    await arm.open()
    assert worker_of(arm) != before


async def test_a_dropped_connection_ends_the_worker_before_it_reconnects(controller: UrEmulator, arm: Ur5Arm) -> None:
    await controller.kill()
    await controller.start()
    await error_of(arm)
    assert not arm._link.up
    assert WATCHDOG not in controller.commands[1:], "nobody but open starts the script anew"
    await arm.open()
    await arm.state()


async def test_a_controller_whose_clock_stands_still_is_given_up(controller: UrEmulator, arm: Ur5Arm) -> None:
    controller.frozen = True
    assert "stood still" in str(await error_of(arm))
    assert not arm._link.up


async def test_without_a_controller_open_names_the_port() -> None:
    arm = Ur5Arm(Ur5Arm.Settings(host=HOST), DriverContext("arm"))
    with pytest.raises(DeviceLost, match=f"no answer from {HOST}:30004"):
        await arm.open()
    assert not arm._link.up


async def test_a_controller_that_accepts_and_says_nothing_does_not_hold_the_loop() -> None:
    async def silence(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()
        writer.close()

    servers = [await asyncio.start_server(silence, HOST, port) for port in (30004, 29999, 30003)]
    arm = Ur5Arm(Ur5Arm.Settings(host=HOST), DriverContext("arm"))
    loop = asyncio.get_running_loop()
    opening = asyncio.ensure_future(arm.open())
    longest_s, last_s, ends_s = 0.0, loop.time(), loop.time() + 1.5
    while loop.time() < ends_s:
        await asyncio.sleep(0.005)
        longest_s, last_s = max(longest_s, loop.time() - last_s), loop.time()
    assert not opening.done()
    assert longest_s < 1.0
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert not arm._link.up
    for server in servers:
        server.close()
    await asyncio.sleep(0.05)
