"""What the DIGIT driver is put through in the test machine. Every scene returns what was seen, as JSON can say it."""

from __future__ import annotations

import asyncio
import grp
import re
import sys
import time
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from plug import attach, modprobe, settle

from slipguard.daemon.loop.capture import SensorCapture, StreamRestarts
from slipguard.devices import DriverContext, Frame
from slipguard.errors import DeviceError, DeviceLost
from slipguard_drivers.digit.camera import DigitSensor
from slipguard_drivers.digit.discovery import DigitDevice, connected_digits
from slipguard_emulators.digit.emulator import DigitEmulator, EmulatedCamera

PATIENCE_S = 20.0
SERIALS = ("D20001", "D20002")
SERIAL = SERIALS[0]
IMAGES = Path("/tmp/images")


async def rates(seconds: float) -> dict[str, object]:
    """vivid, the kernel's test camera, at 320 x 240 and 60 frames a second, through the whole driver."""
    modprobe("vivid", "n_devs=1", "node_types=0x1", "num_inputs=1", "input_types=0x03")
    settle()
    found = DigitDevice(Path("/dev") / names("/sys/class/video4linux")[0], SERIAL, None, "0-0", 0.0)
    sensor = DigitSensor(DigitSensor.Settings(serial=SERIAL), DriverContext("left"), lambda serial, name: found)
    await sensor.open()
    loop = asyncio.get_running_loop()
    ages, captured_s, sequences = [], [], []
    cpu_s, begin_s = time.process_time(), loop.time()
    while loop.time() < begin_s + seconds:
        frame = await sensor.next_frame()
        ages.append(loop.time() - frame.captured_at_s)
        captured_s.append(frame.captured_at_s)
        sequences.append(frame.sequence)
    share = (time.process_time() - cpu_s) / (loop.time() - begin_s)
    remarks, mode = sensor.remarks, sensor.mode
    await sensor.close()
    return {
        "lost": sequences[-1] - sequences[0] + 1 - len(sequences),
        "fps": (len(captured_s) - 1) / (captured_s[-1] - captured_s[0]),
        "handed_out": len(ages),
        "age_ms": 1000 * sorted(ages)[len(ages) // 2],
        "cpu_share": share,
        "mode": str(mode),
        "remarks": remarks,
    }


def draw_images() -> None:
    """Something for the emulated sensors to send that is quickly drawn: a bar that rotates, in noise."""
    for seed, serial in enumerate(SERIALS):
        folder = IMAGES / serial
        folder.mkdir(parents=True)
        rng = np.random.default_rng(seed)
        for number in range(12):
            image = np.full((320, 240, 3), (60 + 80 * seed, 120, 140 - 80 * seed), np.uint8)
            box = cv2.boxPoints(((100.0, 140.0), (150.0, 30.0), 20.0 + number))
            cv2.fillPoly(image, [box.astype(np.int32)], (200, 180, 220))
            noise = rng.integers(0, 4, image.shape, np.uint8)
            cv2.imwrite(str(folder / f"{number:02d}.png"), cv2.GaussianBlur(image, (9, 9), 0) + noise)


@asynccontextmanager
async def emulated(
    serials: tuple[str, ...] = (SERIAL,), nodrop: int = 1, **settings: Any
) -> AsyncIterator[DigitEmulator]:
    """Sensors plugged into this kernel, and their emulator. nodrop: whether the kernel hands on damaged images."""
    modprobe("uvcvideo")
    modprobe("vhci-hcd")
    Path("/sys/module/uvcvideo/parameters/nodrop").write_text(str(nodrop))  # noqa: ASYNC240
    emulator = DigitEmulator(DigitEmulator.Settings(serial=list(serials), port=0, images=IMAGES, **settings))
    await emulator.start()
    try:
        for slot, bus_id in enumerate(emulator.cameras):
            await attach(emulator.port, bus_id, slot)
        await until(lambda: len(usable()) == len(serials))
        yield emulator
    finally:
        await emulator.stop()
        await until(lambda: not connected_digits())


def names(folder: str) -> list[str]:
    """What is in a folder."""
    return sorted(one.name for one in Path(folder).iterdir())


def usable() -> list[DigitDevice]:
    """The sensors whose nodes udev has dealt with."""
    return [one for one in connected_digits() if one.path.exists() and one.path.stat().st_mode & 0o777 == 0o660]


async def until(condition: Callable[[], bool]) -> float:
    """Wait until it is so; the seconds that took. On a thread: /sys waits for a device that this loop has to answer."""
    begin_s = time.monotonic()
    while not await asyncio.to_thread(condition):
        assert time.monotonic() < begin_s + PATIENCE_S, "it never came to that"
        await asyncio.sleep(0.005)
    return time.monotonic() - begin_s


def digit(serial: str = SERIAL, **settings: object) -> DigitSensor:
    """The driver, configured as in config.toml."""
    return DigitSensor(DigitSensor.Settings.model_validate({"serial": serial} | settings), DriverContext("left"))


async def good(sensor: DigitSensor, count: int = 1) -> list[Frame]:
    """The next good frames; what is damaged, repeated or late in between passes."""
    frames: list[Frame] = []
    async with asyncio.timeout(PATIENCE_S):
        while len(frames) < count:
            try:
                frames.append(await sensor.next_frame())
            except DeviceLost:
                raise
            except DeviceError:
                continue
    return frames


async def failure(sensor: DigitSensor) -> DeviceError:
    """The first failure."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            try:
                await sensor.next_frame()
            except DeviceError as error:
                return error


async def two_sensors() -> dict[str, object]:
    """Two sensors on one machine, the second found by its serial, both streaming; what they show is what was sent."""
    async with emulated(SERIALS) as emulator:
        there = await asyncio.to_thread(connected_digits)
        nodes = [one.path.stat() for one in there]
        sensors = [
            digit(serial, fps=30, led_rgb=rgb) for serial, rgb in zip(SERIALS, ((15, 7, 3), (1, 2, 4)), strict=True)
        ]
        for sensor in sensors:
            await sensor.open()
        frames = await asyncio.gather(*(good(sensor, 20) for sensor in sensors))
        cameras = list(emulator.cameras.values())
        return {
            "serials": [one.serial for one in there],
            "firmware": [one.firmware for one in there],
            "groups": [grp.getgrgid(node.st_gid).gr_name for node in nodes],
            "modes": [oct(node.st_mode & 0o777) for node in nodes],
            "by_id": names("/dev/v4l/by-id"),
            "zoom": [camera.unit.zoom for camera in cameras],
            "modes_given": [str(sensor.mode) for sensor in sensors],
            "remarks": [sensor.remarks for sensor in sensors],
            "own": [likeness(some, camera) for some, camera in zip(frames, cameras, strict=True)],
            "other": [likeness(some, camera) for some, camera in zip(frames, cameras[::-1], strict=True)],
            "in_order": all(
                a.sequence < b.sequence and a.captured_at_s < b.captured_at_s
                for some in frames
                for a, b in pairwise(some)
            ),
            "closed": [await sensor.close() for sensor in sensors],
        }


def likeness(frames: list[Frame], camera: EmulatedCamera) -> float:
    """Largest distance of a frame from the nearest image that was sent, in mean gray levels."""
    sent = np.stack(camera.images).astype(np.int16)
    return max(float(np.abs(sent - frame.image).mean(axis=(1, 2, 3)).min()) for frame in frames[:3])


async def contract() -> dict[str, object]:
    """The contract suite, as on real hardware: `pytest tests/contract/test_sensor_contract.py --digit SERIAL`."""
    async with emulated():
        run = await asyncio.create_subprocess_exec(
            *(sys.executable, "-m", "pytest", "-p", "no:cacheprovider", "-q", "-k", "real", "--digit", SERIAL),
            "tests/contract/test_sensor_contract.py",
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.STDOUT,
        )
        says = (await run.communicate())[0].decode()
        counts = {word: int(number) for number, word in re.findall(r"(\d+) (passed|failed|error)", says)}
        return {"passed": counts.get("passed", 0), "failed": run.returncode, "says": says[-4000:]}


async def faults(pixels: str, nodrop: int = 1) -> dict[str, Any]:
    """Every fault in turn: how it is reported, and how soon."""
    expected: dict[str, Any] = {}
    async with emulated(pixels=pixels, nodrop=nodrop) as emulator:
        sensor = digit(fps=30)
        await sensor.open()
        expected["mode"] = str(sensor.mode)
        for fault in ("stall", "freeze", "corrupt", "short"):
            await good(sensor, 5)
            emulator.control(f"fault {fault}")
            begin_s = time.monotonic()
            error = await failure(sensor)
            expected[fault] = {"as": type(error).__name__, "after_s": time.monotonic() - begin_s, "says": str(error)}
            emulator.control(f"clear {fault}")
        await good(sensor, 5)
        await sensor.close()
    return expected


async def replug(unplugged_s: float) -> dict[str, object]:
    """A cable comes loose while the daemon captures, and is plugged in again after a while."""
    async with emulated() as emulator:
        capture = SensorCapture("left", digit(fps=30), 0.5, StreamRestarts(), lambda serial: None, lambda: None)
        running = asyncio.create_task(capture.run())
        try:
            await until(lambda: capture.counts.frames > 10)
            emulator.control("fault unplug")
            await until(lambda: not capture.streaming)
            await asyncio.sleep(unplugged_s)
            gone = not await asyncio.to_thread(connected_digits)
            emulator.control("clear")
            before = capture.counts.frames
            await attach(emulator.port)
            again_s = await until(lambda: capture.counts.frames > before)
        finally:
            running.cancel()
            await asyncio.gather(running, return_exceptions=True)
            await capture.close()
        return {"gone": gone, "again_s": again_s}


async def unplug() -> dict[str, object]:
    """How soon any client that waits for a frame learns that the cable was pulled."""
    async with emulated() as emulator:
        sensor = digit(fps=30)
        await sensor.open()
        await good(sensor, 10)
        waiting = asyncio.ensure_future(failure(sensor))
        await asyncio.sleep(0)
        begin_s = time.monotonic()
        emulator.control("fault unplug")
        error = await waiting
        after_s = time.monotonic() - begin_s
        await sensor.close()
        return {"as": type(error).__name__, "after_s": after_s, "says": str(error)}
