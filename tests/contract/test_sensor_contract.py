"""What `slipguard.devices.TactileSensor` promises, asked of every sensor there is."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from sensor_rigs import Rig, kinds, noise_pictures, rig_of

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen
from slipguard_drivers.digit.replay import ReplaySensor

PATIENCE_S = 5.0


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Each promise on every sensor; those about faults where faults can be had."""
    for name, faults in (("fake", True), ("rig", False)):
        if name in metafunc.fixturenames:
            metafunc.parametrize(f"{name}_kind", kinds(metafunc.config, with_faults=faults))


@pytest.fixture
async def fake(fake_kind: str, tmp_path: Path, pytestconfig: pytest.Config) -> AsyncIterator[Rig]:
    rig = rig_of(fake_kind, tmp_path, pytestconfig)
    await rig.begin()
    yield rig
    await rig.sensor.close()
    await rig.end()


@pytest.fixture
async def rig(rig_kind: str, tmp_path: Path, pytestconfig: pytest.Config) -> AsyncIterator[Rig]:
    rig = rig_of(rig_kind, tmp_path, pytestconfig)
    await rig.begin()
    yield rig
    await rig.sensor.close()
    await rig.end()


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


async def test_frames_are_portrait_pictures_read_only_and_fresh(rig: Rig) -> None:
    known = rig.sensor.serial
    await rig.sensor.open()
    assert rig.sensor.serial
    assert known in ("", rig.sensor.serial)
    frame = await good_frame(rig.sensor)
    assert frame.image.shape == (320, 240, 3)
    assert frame.image.dtype == np.uint8
    assert not frame.image.flags.writeable
    assert frame.image.std() > 1.0
    age_s = asyncio.get_running_loop().time() - frame.captured_at_s
    assert 0.0 <= age_s < rig.slowest_s


async def test_no_frame_comes_twice_and_time_only_advances(rig: Rig) -> None:
    await rig.sensor.open()
    frames = [await good_frame(rig.sensor) for _ in range(30)]
    for before, after in pairwise(frames):
        assert after.sequence > before.sequence
        assert after.captured_at_s > before.captured_at_s
        assert not np.array_equal(after.image, before.image)


async def test_the_newest_frame_wins(rig: Rig) -> None:
    await rig.sensor.open()
    before = await good_frame(rig.sensor)
    await asyncio.sleep(0.9)
    after = await good_frame(rig.sensor)
    assert asyncio.get_running_loop().time() - after.captured_at_s < rig.slowest_s
    assert after.sequence > before.sequence + 5


async def test_before_open_and_after_close_it_is_lost(rig: Rig) -> None:
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


async def test_a_caller_that_gives_up_upsets_nobody(rig: Rig) -> None:
    await rig.sensor.open()
    given_up = 0
    for _ in range(20):
        try:
            await asyncio.wait_for(rig.sensor.next_frame(), 0.002)
        except TimeoutError:
            given_up += 1
    assert given_up, "a frame every 2 ms is none of a camera"
    assert (await good_frame(rig.sensor)).image.shape == (320, 240, 3)


async def test_a_stalled_stream_times_out_and_goes_on_when_mended(fake: Rig) -> None:
    await fake.sensor.open()
    await good_frame(fake.sensor)
    fake.fail("stall")
    assert isinstance(await failure(fake.sensor), DeviceTimeout)
    assert isinstance(await failure(fake.sensor), DeviceTimeout)
    fake.repair("stall")
    await good_frame(fake.sensor)


async def test_a_frozen_camera_is_told_and_its_picture_never_handed_out_again(fake: Rig) -> None:
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
    fake.repair("frozen")
    await good_frame(fake.sensor)


async def test_a_damaged_frame_is_told_and_the_next_may_be_fine(fake: Rig) -> None:
    await fake.sensor.open()
    fake.fail("corrupt")
    assert isinstance(await failure(fake.sensor), FrameCorrupt)
    fake.repair("corrupt")
    await good_frame(fake.sensor)


async def test_an_unplugged_sensor_is_lost_until_it_is_opened_again(fake: Rig) -> None:
    await fake.sensor.open()
    await good_frame(fake.sensor)
    waiting = asyncio.ensure_future(failure(fake.sensor))
    fake.fail("disconnect")
    assert isinstance(await waiting, DeviceLost)
    with pytest.raises(DeviceLost):
        await fake.sensor.open()
    fake.repair("disconnect")
    with pytest.raises(DeviceLost):
        await good_frame(fake.sensor)
    await fake.sensor.open()
    await good_frame(fake.sensor)


async def test_a_recording_ends_where_it_is_not_to_be_repeated(tmp_path: Path) -> None:
    noise_pictures(tmp_path)
    sensor = ReplaySensor(ReplaySensor.Settings(path=tmp_path, loop=False), DriverContext("left"))
    await sensor.open()
    ended = await failure(sensor)
    assert isinstance(ended, DeviceLost)
    assert "ended" in str(ended)
    await sensor.open()
    assert (await sensor.next_frame()).sequence == 1
    await sensor.close()
