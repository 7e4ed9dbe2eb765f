"""Helpers for tests of the arm driver against an emulated controller."""

from __future__ import annotations

import asyncio
import contextlib
import os
from collections.abc import Callable

import pytest

from slipguard.devices import Arm
from slipguard.errors import DeviceError, DeviceLost
from slipguard_drivers.ur5.lift_mode import LiftModeArm
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_emulators.ur5.emulator import UrEmulator


def own_address(number: int) -> str:
    """A loopback address that no other run of the tests uses; the ports of a controller cannot be chosen."""
    return f"127.{20 + os.getpid() // 256 % 200}.{os.getpid() % 256}.{number}"


BUILT: list[LiftModeArm] = []


def lifting(host: str, **settings: object) -> LiftModeArm:
    """The driver in lift mode, not yet opened; `put_away` closes it."""
    arm = LiftModeArm("arm", Ur5Settings.model_validate({"host": host, "watchdog_hz": 2.0, **settings}))
    BUILT.append(arm)
    return arm


async def opened(arm: Arm) -> None:
    """Open it; a machine too busy for the deadlines is given further chances."""
    for _ in range(4):
        with contextlib.suppress(DeviceLost):
            await arm.open()
            return
    await arm.open()


async def refusal(arm: Arm, words: str) -> str:
    """What `open` says; tried again where a busy machine has missed a deadline and `words` are not in it."""
    said = ""
    for _ in range(4):
        with pytest.raises(DeviceLost) as caught:
            await arm.open()
        said = str(caught.value)
        if words in said:
            break
    return said


async def put_away() -> None:
    """Close all that were built. A second close opens of what the first keeps for another `open`."""
    while BUILT:
        arm = BUILT.pop()
        await arm.close()
        await arm.close()


def speed_of(controller: UrEmulator) -> float:
    """The truth, in m/s."""
    return max(abs(part) for part in controller.tool.velocity(asyncio.get_running_loop().time()))


def script_commands(controller: UrEmulator) -> list[str]:
    """Return the commands that the control script received, in order."""
    return [str(event["what"]) for event in controller.events("command")]


async def until(question: Callable[[], object], within_s: float = 3.0) -> bool:
    """Whether it becomes true in time."""
    loop = asyncio.get_running_loop()
    ends_s = loop.time() + within_s
    for _ in range(100_000):
        if question():
            return True
        if loop.time() > ends_s:
            return False
        await asyncio.sleep(0.005)
    return False


async def rests(controller: UrEmulator, within_s: float = 2.0) -> bool:
    """Whether the arm comes to rest in time."""
    return await until(lambda: speed_of(controller) == 0.0, within_s)


async def under_way(arm: Arm, controller: UrEmulator) -> None:
    """Lift, and wait until it really moves. A machine too busy for the watchdog is given further chances."""
    for _ in range(3):
        try:
            await arm.lift(400.0, 100.0)
            if await until(lambda: speed_of(controller) > 0.05):
                return
        except DeviceError:
            await opened(arm)
    pytest.fail("it does not move")


async def lost(arm: Arm, within_s: float = 4.0) -> str:
    """Wait until the driver says that the arm is lost; why."""
    async with asyncio.timeout(within_s):
        while True:
            try:
                await arm.state()
            except DeviceLost as error:
                return str(error)
            except DeviceError:
                pass
            await asyncio.sleep(0.005)
