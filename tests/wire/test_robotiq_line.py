"""The real gripper driver on a bad line, and where it alone may move fingers."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from robotiq_emulator import RobotiqEmulator, crc16

from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.line import RegisterLine


def settings(emulator: RobotiqEmulator) -> RobotiqGripper.Settings:
    return RobotiqGripper.Settings(port=str(emulator.path), approach_speed=1.0)


@pytest.fixture
async def emulator(tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    emulator = RobotiqEmulator(tmp_path / "ttyGripper")
    yield emulator
    emulator.unplug()


@pytest.fixture
async def gripper(emulator: RobotiqEmulator) -> AsyncIterator[RobotiqGripper]:
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    await gripper.open()
    yield gripper
    await gripper.close()


async def until_it_holds(gripper: RobotiqGripper) -> None:
    for _ in range(200):
        if (await gripper.state()).holding:
            return
        await asyncio.sleep(0.01)
    pytest.fail("it does not hold")


@pytest.mark.parametrize(
    "frame",
    [
        "09 10 03E8 0003 06 0900 0000 FFFF 7219",
        "09 10 03E8 0003 0130",
        "09 04 07D0 0003 B1CE",
        "09 04 06 B900 00FF BD00 5C9A",
    ],
)
def test_the_doubles_checksum_is_the_manuals(frame: str) -> None:
    raw = bytes.fromhex(frame)
    assert crc16(raw[:-2]) == raw[-2:]


async def test_only_a_release_activates(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    assert not (await gripper.state()).active
    for command in (gripper.hold(40.0), gripper.move(50.0, 40.0)):
        with pytest.raises(CommandRefused, match="not activated"):
            await command
    assert emulator.fingers.activations == 0
    assert emulator.fingers.writes == []
    await gripper.release(85.0)
    assert emulator.fingers.activations == 1
    assert (await gripper.state()).active
    await gripper.release(60.0)
    assert emulator.fingers.activations == 1


async def test_a_release_clears_a_fault(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    await gripper.release(85.0)
    emulator.fingers.fault = 0x0E
    assert (await gripper.state()).fault == "overcurrent"
    await gripper.release(85.0)
    assert (await gripper.state()).fault is None


async def test_tightening_is_stop_then_go_and_never_lets_go(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    await gripper.release(85.0)
    emulator.fingers.object_at = 120.0
    await gripper.hold(40.0)
    await until_it_holds(gripper)
    emulator.fingers.writes.clear()
    await gripper.hold(80.0)
    stop, go = emulator.fingers.writes
    assert (stop[0], go[0]) == (0x0100, 0x0900), "rACT stays set; rGTO 0, then 1"
    assert stop[1] == go[1] == 255
    assert go[2] & 0xFF == 72  # 20 N + 72 x 0.843 N


@pytest.mark.parametrize("after_s", [0.001, 0.006, 0.011, 0.016])
async def test_a_tightening_whose_caller_gives_up_is_finished(
    emulator: RobotiqEmulator, gripper: RobotiqGripper, after_s: float
) -> None:
    await gripper.release(85.0)
    emulator.fingers.object_at = 120.0
    await gripper.hold(40.0)
    await until_it_holds(gripper)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(gripper.hold(80.0), after_s)
    await asyncio.sleep(0.1)
    await gripper.state()
    assert emulator.fingers.going
    assert emulator.fingers.grip == 72


async def test_a_late_answer_is_never_taken_for_the_next(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    await gripper.release(85.0)
    emulator.delay_s = 0.08
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    emulator.delay_s = 0.0
    emulator.fingers.object_at = 120.0
    await gripper.hold(40.0)
    await until_it_holds(gripper)


async def test_after_a_time_out_the_line_is_silent_for_a_while(
    emulator: RobotiqEmulator, gripper: RobotiqGripper
) -> None:
    emulator.mute = True
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    loop = asyncio.get_running_loop()
    timed_out_at_s, asked = loop.time(), emulator.requests
    emulator.mute = False
    await gripper.state()
    assert emulator.requests == asked + 1
    assert loop.time() - timed_out_at_s >= 0.099


async def test_requests_keep_their_distance(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    loop = asyncio.get_running_loop()
    before_s = loop.time()
    await asyncio.gather(*(gripper.state() for _ in range(11)))
    assert loop.time() - before_s >= 10 * 0.005 - 1e-6


async def test_a_torn_answer_is_put_together(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.split = True
    for _ in range(5):
        await gripper.state()


async def test_a_wrong_checksum_is_no_answer(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    emulator.bad_crc = True
    with pytest.raises(DeviceTimeout):
        await gripper.state()
    emulator.bad_crc = False
    await gripper.state()


async def test_an_answer_of_the_wrong_kind_is_refused(emulator: RobotiqEmulator) -> None:
    line = RegisterLine("gripper", str(emulator.path), 9, 0.05)
    await line.connect()
    read_answer = bytes.fromhex("09 04 06 B900 00FF BD00")
    emulator._answer = lambda request: read_answer  # type: ignore[method-assign]
    with pytest.raises(DeviceTimeout, match="another request"):
        await line.write(0x03E8, [0x0900, 0, 0])
    with pytest.raises(DeviceTimeout, match="another request"):
        await line.read(0x07D0, 2)
    line.close()


async def test_a_gripper_that_takes_no_commands_is_told(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    await gripper.release(85.0)
    emulator.fingers.write = lambda registers, now_s: None  # type: ignore[method-assign]
    with pytest.raises(DeviceLost, match="another program"):
        await gripper.hold(40.0)


async def test_the_port_is_ours_alone(emulator: RobotiqEmulator, gripper: RobotiqGripper) -> None:
    second = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    with pytest.raises(DeviceLost, match="another program"):
        await second.open()
    await second.close()
    await gripper.state()


async def test_a_port_that_is_not_there_is_told(tmp_path: Path) -> None:
    gripper = RobotiqGripper(RobotiqGripper.Settings(port=str(tmp_path / "nothing")), DriverContext("gripper"))
    with pytest.raises(DeviceLost, match="no such device"):
        await gripper.open()
    await gripper.close()


async def test_a_silent_gripper_at_open_leaves_the_port_free(emulator: RobotiqEmulator) -> None:
    emulator.mute = True
    gripper = RobotiqGripper(settings(emulator), DriverContext("gripper"))
    with pytest.raises(DeviceTimeout, match="power"):
        await gripper.open()
    emulator.mute = False
    await gripper.open()
    await gripper.close()
