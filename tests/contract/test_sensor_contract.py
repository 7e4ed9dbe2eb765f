"""The contract of `slipguard.devices.TactileSensor`, checked on every sensor."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from rig import needs, parametrize_rig
from sensor_rigs import SensorRig, abilities, make_rig, write_noise_images

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceError, DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen
from slipguard_drivers.digit.replay import ReplaySensor

TIMEOUT_S = 5.0


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    parametrize_rig(metafunc, abilities(metafunc.config))


@pytest.fixture
async def rig(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[SensorRig]:
    rig = make_rig(request.param, tmp_path, request.config)
    await rig.start()
    yield rig
    await rig.sensor.close()
    await rig.stop()


async def good_frame(sensor: TactileSensor) -> Frame:
    """Return the next good frame; earlier frames may be damaged."""
    async with asyncio.timeout(TIMEOUT_S):
        while True:
            try:
                return await sensor.next_frame()
            except DeviceError as error:
                if isinstance(error, DeviceLost):
                    raise


async def failure(sensor: TactileSensor) -> DeviceError:
    """Return the first error; good frames before it are ignored."""
    async with asyncio.timeout(TIMEOUT_S):
        while True:
            try:
                await sensor.next_frame()
            except DeviceError as error:
                return error


@pytest.mark.realtime
async def test_frames_are_portrait_images_read_only_and_fresh(rig: SensorRig) -> None:
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
    assert 0.0 <= age_s < rig.latency_max_s


async def test_no_frame_is_repeated_and_time_advances(rig: SensorRig) -> None:
    await rig.sensor.open()
    frames = [await good_frame(rig.sensor) for _ in range(30)]
    for before, after in pairwise(frames):
        assert after.sequence > before.sequence
        assert after.captured_at_s > before.captured_at_s
        assert not np.array_equal(after.image, before.image)


@pytest.mark.realtime
async def test_the_newest_frame_wins(rig: SensorRig) -> None:
    await rig.sensor.open()
    before = await good_frame(rig.sensor)
    await asyncio.sleep(0.9)
    after = await good_frame(rig.sensor)
    assert asyncio.get_running_loop().time() - after.captured_at_s < rig.latency_max_s
    assert after.sequence > before.sequence + 5


async def test_a_sensor_that_is_not_open_is_lost(rig: SensorRig) -> None:
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


async def test_a_cancelled_call_does_no_harm(rig: SensorRig) -> None:
    await rig.sensor.open()
    cancelled = 0
    for _ in range(20):
        try:
            await asyncio.wait_for(rig.sensor.next_frame(), 0.002)
        except TimeoutError:
            cancelled += 1
    assert cancelled, "no camera delivers a frame every 2 ms"
    assert (await good_frame(rig.sensor)).image.shape == (320, 240, 3)


@needs("faults")
async def test_a_stalled_stream_times_out_and_continues_after_repair(rig: SensorRig) -> None:
    await rig.sensor.open()
    await good_frame(rig.sensor)
    rig.fail("stall")
    assert isinstance(await failure(rig.sensor), DeviceTimeout)
    assert isinstance(await failure(rig.sensor), DeviceTimeout)
    rig.repair("stall")
    await good_frame(rig.sensor)


@needs("faults")
async def test_a_frozen_camera_is_reported_and_its_image_never_repeated(rig: SensorRig) -> None:
    await rig.sensor.open()
    await good_frame(rig.sensor)
    rig.fail("frozen")
    received: list[Frame] = []

    async def collect() -> None:
        while True:
            received.append(await rig.sensor.next_frame())

    with pytest.raises(FrameFrozen):
        await asyncio.wait_for(collect(), TIMEOUT_S)
    for before, after in pairwise(received):
        assert not np.array_equal(before.image, after.image)
    rig.repair("frozen")
    await good_frame(rig.sensor)


@needs("faults")
async def test_a_damaged_frame_is_reported_and_the_next_may_be_good(rig: SensorRig) -> None:
    await rig.sensor.open()
    rig.fail("corrupt")
    assert isinstance(await failure(rig.sensor), FrameCorrupt)
    rig.repair("corrupt")
    await good_frame(rig.sensor)


@needs("faults")
async def test_an_unplugged_sensor_is_lost_until_it_is_opened_again(rig: SensorRig) -> None:
    await rig.sensor.open()
    await good_frame(rig.sensor)
    waiting = asyncio.ensure_future(failure(rig.sensor))
    rig.fail("disconnect")
    assert isinstance(await waiting, DeviceLost)
    with pytest.raises(DeviceLost):
        await rig.sensor.open()
    rig.repair("disconnect")
    with pytest.raises(DeviceLost):
        await good_frame(rig.sensor)
    await rig.sensor.open()
    await good_frame(rig.sensor)


async def test_a_recording_ends_if_it_is_not_repeated(tmp_path: Path) -> None:
    write_noise_images(tmp_path)
    sensor = ReplaySensor(ReplaySensor.Settings(path=tmp_path, loop=False), DriverContext("left"))
    await sensor.open()
    error = await failure(sensor)
    assert isinstance(error, DeviceLost)
    assert "ended" in str(error)
    await sensor.open()
    assert (await sensor.next_frame()).sequence == 1
    await sensor.close()
