"""What `slipguard.devices.TactileSensor` promises, asked of every sensor there is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen
from slipguard.sim.world import World
from slipguard_drivers.cell.frame_server import FrameServer
from slipguard_drivers.cell.socket_sensor import SocketSensor
from slipguard_drivers.digit.fake import FakeSensor
from slipguard_drivers.digit.replay import ReplaySensor

PATIENCE_S = 5.0


class FakeRig:
    """A finger of an empty world. slowest_s: from exposure to hand-over on a machine busy with other things."""

    slowest_s = 0.7

    def __init__(self, draw: str) -> None:
        self.world = World()
        self.sensor: TactileSensor = FakeSensor(
            FakeSensor.Settings.model_validate({"draw": draw, "stall_ms": 500}), DriverContext("left", self.world)
        )

    def fail(self, kind: str) -> None:
        self.world.faults.fail("left", kind)

    def mend(self, kind: str) -> None:
        self.world.faults.mend("left", kind)

    async def close(self) -> None:
        """Nothing but the sensor to put away."""


class SocketRig(FakeRig):
    """The same finger behind a frame server, read by the driver of the socket."""

    def __init__(self, folder: Path) -> None:
        super().__init__("inline")
        self.server = FrameServer(folder / "left.sock", self.sensor, fps=60.0)
        self.server.plug()
        settings = SocketSensor.Settings(path=self.server.path, stall_ms=500)
        self.sensor = SocketSensor(settings, DriverContext("left"))

    def fail(self, kind: str) -> None:
        super().fail(kind)
        if kind == "disconnect":
            self.server.unplug()

    def mend(self, kind: str) -> None:
        super().mend(kind)
        self.server.plug()

    async def close(self) -> None:
        await self.server.close()


class ReplayRig:
    """A folder of seven noise pictures, played for ever."""

    slowest_s = 0.7

    def __init__(self, folder: Path) -> None:
        rng = np.random.default_rng(5)
        for number in range(7):
            cv2.imwrite(str(folder / f"{number}.png"), rng.integers(0, 256, (320, 240, 3), np.uint8))
        self.sensor: TactileSensor = ReplaySensor(ReplaySensor.Settings(path=folder), DriverContext("left"))

    async def close(self) -> None:
        """Nothing but the sensor to put away."""


@pytest.fixture(params=["inline", "process", "socket"])
async def fake(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[FakeRig]:
    rig = SocketRig(tmp_path) if request.param == "socket" else FakeRig(request.param)
    yield rig
    await rig.sensor.close()
    await rig.close()


@pytest.fixture(params=["inline", "process", "socket", "replay"])
async def rig(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[FakeRig | ReplayRig]:
    rig: FakeRig | ReplayRig
    if request.param == "replay":
        rig = ReplayRig(tmp_path)
    else:
        rig = SocketRig(tmp_path) if request.param == "socket" else FakeRig(request.param)
    yield rig
    await rig.sensor.close()
    await rig.close()


async def good_frame(sensor: TactileSensor) -> Frame:
    """The next frame; what was still on its way from before may be damaged."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                return await sensor.next_frame()
            except DeviceError as error:
                if isinstance(error, DeviceLost):
                    raise


async def failure(sensor: TactileSensor) -> DeviceError:
    """The first failure; good frames still on their way pass."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                await sensor.next_frame()
            except DeviceError as error:
                return error


async def test_frames_are_portrait_pictures_read_only_and_fresh(rig: FakeRig | ReplayRig) -> None:
    await rig.sensor.open()
    assert rig.sensor.serial
    frame = await good_frame(rig.sensor)
    assert frame.image.shape == (320, 240, 3)
    assert frame.image.dtype == np.uint8
    assert not frame.image.flags.writeable
    assert frame.image.std() > 1.0
    age_s = asyncio.get_running_loop().time() - frame.captured_at_s
    assert 0.0 <= age_s < rig.slowest_s


async def test_no_frame_comes_twice_and_time_only_advances(rig: FakeRig | ReplayRig) -> None:
    await rig.sensor.open()
    frames = [await good_frame(rig.sensor) for _ in range(30)]
    for before, after in pairwise(frames):
        assert after.sequence > before.sequence
        assert after.captured_at_s > before.captured_at_s
        assert not np.array_equal(after.image, before.image)


async def test_the_newest_frame_wins(rig: FakeRig | ReplayRig) -> None:
    await rig.sensor.open()
    before = await good_frame(rig.sensor)
    await asyncio.sleep(0.9)
    after = await good_frame(rig.sensor)
    assert asyncio.get_running_loop().time() - after.captured_at_s < rig.slowest_s
    assert after.sequence > before.sequence + 5


async def test_before_open_and_after_close_it_is_lost(rig: FakeRig | ReplayRig) -> None:
    with pytest.raises(DeviceLost):
        await rig.sensor.next_frame()
    await rig.sensor.open()
    await rig.sensor.open()
    await good_frame(rig.sensor)
    await rig.sensor.close()
    await rig.sensor.close()
    with pytest.raises(DeviceLost):
        await rig.sensor.next_frame()
    await rig.sensor.open()
    await good_frame(rig.sensor)


async def test_a_caller_that_gives_up_upsets_nobody(rig: FakeRig | ReplayRig) -> None:
    await rig.sensor.open()
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(rig.sensor.next_frame(), 0.002)
    assert (await good_frame(rig.sensor)).image.shape == (320, 240, 3)


async def test_a_stalled_stream_times_out_and_goes_on_when_mended(fake: FakeRig) -> None:
    await fake.sensor.open()
    await good_frame(fake.sensor)
    fake.fail("stall")
    assert isinstance(await failure(fake.sensor), DeviceTimeout)
    assert isinstance(await failure(fake.sensor), DeviceTimeout)
    fake.mend("stall")
    await good_frame(fake.sensor)


async def test_a_frozen_camera_is_told_and_its_picture_never_handed_out_again(fake: FakeRig) -> None:
    await fake.sensor.open()
    await good_frame(fake.sensor)
    fake.fail("frozen")
    handed_out: list[Frame] = []

    async def collect() -> None:
        while True:
            handed_out.append(await fake.sensor.next_frame())

    with pytest.raises(FrameFrozen):
        await asyncio.wait_for(collect(), PATIENCE_S)
    for before, after in pairwise(handed_out):
        assert not np.array_equal(before.image, after.image)
    fake.mend("frozen")
    await good_frame(fake.sensor)


async def test_a_damaged_frame_is_told_and_the_next_may_be_fine(fake: FakeRig) -> None:
    await fake.sensor.open()
    fake.fail("corrupt")
    assert isinstance(await failure(fake.sensor), FrameCorrupt)
    fake.mend("corrupt")
    await good_frame(fake.sensor)


async def test_an_unplugged_sensor_is_lost_until_it_is_opened_again(fake: FakeRig) -> None:
    await fake.sensor.open()
    await good_frame(fake.sensor)
    waiting = asyncio.ensure_future(failure(fake.sensor))
    fake.fail("disconnect")
    assert isinstance(await waiting, DeviceLost)
    with pytest.raises(DeviceLost):
        await fake.sensor.open()
    fake.mend("disconnect")
    with pytest.raises(DeviceLost):
        await good_frame(fake.sensor)
    await fake.sensor.open()
    await good_frame(fake.sensor)


async def test_a_recording_ends_where_it_is_not_to_be_repeated(tmp_path: Path) -> None:
    ReplayRig(tmp_path)
    sensor = ReplaySensor(ReplaySensor.Settings(path=tmp_path, loop=False), DriverContext("left"))
    await sensor.open()
    ended = await failure(sensor)
    assert isinstance(ended, DeviceLost)
    assert "ended" in str(ended)
    await sensor.open()
    assert (await sensor.next_frame()).sequence == 1
    await sensor.close()
