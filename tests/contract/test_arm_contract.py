"""What `slipguard.devices.Arm` promises, asked of every arm there is."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import AsyncIterator
from typing import Protocol

import pytest
from patience import eventually
from ur_emulator import EMERGENCY, NORMAL, PROTECTIVE, UrEmulator

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard.sim.world import World
from slipguard_drivers.ur5.arm import Ur5Arm
from slipguard_drivers.ur5.fake import FakeArm


class Rig(Protocol):
    """An arm and a way to break it."""

    arm: Arm

    async def start(self) -> None: ...
    async def fail(self, kind: str) -> None: ...
    async def mend(self, kind: str) -> None: ...
    async def end(self) -> None: ...


class FakeRig:
    """The arm of an empty world."""

    def __init__(self) -> None:
        self.world = World()
        self.arm: Arm = FakeArm(FakeArm.Settings(), DriverContext("arm", self.world))

    async def start(self) -> None:
        """It is there from the start."""

    async def fail(self, kind: str) -> None:
        self.world.faults.fail("arm", kind)

    async def mend(self, kind: str) -> None:
        self.world.faults.mend("arm", kind)

    async def end(self) -> None:
        """Nothing to put away."""


class WireRig:
    """The real driver with ur-rtde in its process, and an emulated controller on a loopback address of its own."""

    def __init__(self) -> None:
        self.controller = UrEmulator("127.0.0.30")
        settings = Ur5Arm.Settings(host=self.controller.host, acceleration_mm_s2=1200.0)
        self.arm: Arm = Ur5Arm(settings, DriverContext("arm"))

    async def start(self) -> None:
        await self.controller.start()

    async def fail(self, kind: str) -> None:
        if kind == "disconnect":
            await self.controller.kill()
        elif kind == "timeout":
            self.controller.frozen = True
        else:
            self.controller.safety_stop(PROTECTIVE if kind == "protective_stop" else EMERGENCY)

    async def mend(self, kind: str) -> None:
        if kind == "disconnect":
            await self.controller.start()
        elif kind == "timeout":
            self.controller.frozen = False
        else:
            self.controller.safety_stop(NORMAL)

    async def end(self) -> None:
        await self.controller.kill()


@pytest.fixture(params=[FakeRig, WireRig], ids=["fake", "wire"])
async def rig(request: pytest.FixtureRequest) -> AsyncIterator[Rig]:
    rig: Rig = request.param()
    await rig.start()
    yield rig
    await rig.arm.close()
    await rig.end()


@pytest.fixture
async def arm(rig: Rig) -> Arm:
    await rig.arm.open()
    return rig.arm


def at_rest(state: ArmState) -> bool:
    return not state.moving and state.speed_mm_s == pytest.approx(0.0)


async def test_it_rests_at_height_zero_where_it_was_found(rig: Rig, arm: Arm) -> None:
    assert (await arm.state()).height_mm == pytest.approx(0.0)
    await arm.lift(10.0, 200.0)
    await eventually(arm.state, lambda state: state.height_mm > 9.9 and at_rest(state))
    await arm.close()
    await arm.open()
    assert (await arm.state()).height_mm == pytest.approx(0.0)


async def test_a_lift_starts_and_does_not_wait(arm: Arm) -> None:
    before_s = asyncio.get_running_loop().time()
    assert await arm.lift(30.0, 100.0) == pytest.approx(100.0)
    assert asyncio.get_running_loop().time() - before_s < 0.2, "30 mm at 100 mm/s take 0.38 s"
    await eventually(arm.state, lambda state: state.moving and state.speed_mm_s > 0)
    await eventually(arm.state, lambda state: at_rest(state) and state.height_mm == pytest.approx(30.0, abs=0.1))
    await arm.lift(-20.0, 100.0)
    await eventually(arm.state, lambda state: at_rest(state) and state.height_mm == pytest.approx(10.0, abs=0.1))


async def test_a_speed_beyond_its_limit_is_cut_and_told(arm: Arm) -> None:
    assert 0 < await arm.lift(5.0, 1e6) <= 1000.0


async def test_stop_ends_a_motion_and_may_come_at_any_time(arm: Arm) -> None:
    await arm.stop()
    await arm.lift(300.0, 150.0)
    await eventually(arm.state, lambda state: state.height_mm > 5.0)
    await arm.stop()
    await arm.stop()
    stopped = await eventually(arm.state, at_rest)
    assert stopped.height_mm < 150.0
    await asyncio.sleep(0.1)
    assert (await arm.state()).height_mm == pytest.approx(stopped.height_mm, abs=0.1)


async def test_close_stops_the_arm(arm: Arm) -> None:
    await arm.lift(300.0, 150.0)
    await eventually(arm.state, lambda state: state.moving)
    await arm.close()
    await arm.open()
    await eventually(arm.state, at_rest)
    assert (await arm.state()).height_mm < 50.0


@pytest.mark.parametrize(("height_mm", "speed_mm_s"), [(math.nan, 50.0), (10.0, math.nan), (10.0, 0.0), (10.0, -5.0)])
async def test_a_lift_that_makes_no_sense_is_refused(arm: Arm, height_mm: float, speed_mm_s: float) -> None:
    with pytest.raises(CommandRefused):
        await arm.lift(height_mm, speed_mm_s)
    assert not (await arm.state()).moving


@pytest.mark.parametrize("kind", ["protective_stop", "emergency_stop"])
async def test_a_safety_stop_is_seen_and_refuses_motion(rig: Rig, arm: Arm, kind: str) -> None:
    await arm.lift(300.0, 100.0)
    await eventually(arm.state, lambda state: state.moving)
    await rig.fail(kind)
    state = await eventually(arm.state, lambda state: bool(getattr(state, kind)))
    assert state.protective_stop == (kind == "protective_stop")
    await eventually(arm.state, at_rest)
    with pytest.raises(CommandRefused, match="stop is active"):
        await arm.lift(10.0, 100.0)
    await arm.stop()
    await rig.mend(kind)
    await eventually(lambda: _lift_opening_again(arm), bool)


async def test_an_arm_that_falls_silent_times_out(rig: Rig, arm: Arm) -> None:
    await rig.fail("timeout")
    assert isinstance(await asyncio.wait_for(_failure(arm), 1.0), DeviceTimeout)
    with pytest.raises(DeviceTimeout):
        await asyncio.wait_for(arm.state(), 1.0)
    await rig.mend("timeout")

    async def answers() -> bool:
        try:
            return bool(await arm.state())
        except DeviceTimeout:
            return False

    await eventually(answers, bool)


async def test_a_lost_arm_comes_back_with_open(rig: Rig, arm: Arm) -> None:
    await rig.fail("disconnect")
    assert isinstance(await asyncio.wait_for(_failure(arm), 3.0), DeviceLost)
    with pytest.raises(DeviceLost):
        await arm.open()
    await rig.mend("disconnect")
    with pytest.raises(DeviceLost):
        await arm.lift(10.0, 50.0)
    await arm.open()
    assert not (await arm.state()).moving


async def test_before_open_and_after_close_it_is_lost(rig: Rig) -> None:
    with pytest.raises(DeviceLost):
        await rig.arm.state()
    await rig.arm.open()
    await rig.arm.open()
    await rig.arm.state()
    await rig.arm.close()
    await rig.arm.close()
    for command in (rig.arm.state, rig.arm.stop, lambda: rig.arm.lift(1.0, 10.0)):
        with pytest.raises(DeviceLost):
            await command()


async def test_a_caller_that_gives_up_upsets_nobody(arm: Arm) -> None:
    for command in (arm.state, arm.stop, lambda: arm.lift(1.0, 10.0)):
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(command(), 0.0005)
        await arm.state()


async def _failure(arm: Arm) -> DeviceError:
    while True:
        try:
            await arm.state()
        except DeviceError as error:
            return error
        await asyncio.sleep(0.005)


async def _lift_opening_again(arm: Arm) -> bool:
    """A controller needs a new connection after a safety stop; a stop not yet cleared refuses."""
    try:
        return await arm.lift(10.0, 100.0) > 0
    except DeviceLost:
        await arm.open()
    except CommandRefused:
        pass
    return False
