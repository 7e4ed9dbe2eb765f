"""The emulated DIGIT as a USB host sees it: connected, enumerated, streaming, disconnected."""

from __future__ import annotations

import asyncio
import errno
import struct
from collections.abc import AsyncIterator, Callable
from itertools import pairwise
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
import pytest
from pydantic import ValidationError
from usb_host import UsbCapture, UsbDevice, connected, exactly, listed

from slipguard.errors import CommandRefused, InputError
from slipguard_drivers.digit.capture import RawFrame, VideoMode
from slipguard_drivers.digit.decoding import decode_yuyv
from slipguard_drivers.digit.v4l2 import ZOOM_ABSOLUTE
from slipguard_emulators.digit.emulator import DigitEmulator
from slipguard_emulators.digit.usbip import BulkInEndpoint

T = TypeVar("T")
QVGA = VideoMode("YUYV", 320, 240, 60.0)


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two folders by serial: one dark, one bright."""
    folder = tmp_path_factory.mktemp("images")
    for level, serial in ((40, "D20001"), (160, "D20002")):
        (folder / serial).mkdir()
        for number in range(3):
            image = np.full((320, 240, 3), level + number, np.uint8)
            image[:20, :20] = 250
            cv2.imwrite(str(folder / serial / f"{number}.png"), image)
    return folder


@pytest.fixture
async def emulator(images: Path) -> AsyncIterator[DigitEmulator]:
    settings = DigitEmulator.Settings(serial=["D20001", "D20002"], port=0, images=images)
    emulator = DigitEmulator(settings)
    await emulator.start()
    yield emulator
    await emulator.stop()


async def in_thread(work: Callable[[], T]) -> T:
    """A host blocks, so it works on another thread than the emulator."""
    return await asyncio.to_thread(work)


async def frames(capture: UsbCapture, count: int) -> list[RawFrame]:
    taken: list[RawFrame] = []
    for _ in range(1000):
        while len(taken) < count and (one := capture.take()) is not None:
            taken.append(one)
        if len(taken) == count:
            return taken
        await asyncio.sleep(0.005)
    pytest.fail(f"only {len(taken)} of {count} frames came")


async def test_two_sensors_are_listed_and_each_accepts_one_host(emulator: DigitEmulator) -> None:
    assert await in_thread(lambda: listed(emulator.address)) == ["1-1", "1-2"]
    device = await in_thread(lambda: UsbDevice(emulator.address, "1-1"))
    with pytest.raises(OSError, match="busy"):
        await in_thread(lambda: UsbDevice(emulator.address, "1-1"))
    serial = await in_thread(lambda: device.control(0x80, 6, 0x0303, 0x0409, 255))
    assert serial[2:].decode("utf-16-le") == "D20001"
    await in_thread(device.close)
    again = await in_thread(lambda: UsbDevice(emulator.address, "1-1"))
    await in_thread(again.close)


async def test_its_modes_are_a_digits(emulator: DigitEmulator) -> None:
    capture = await in_thread(lambda: UsbCapture(f"{emulator.address}/1-1"))
    offered = {(mode.pixels, mode.width_px, mode.height_px, mode.fps) for mode in capture.modes()}
    assert offered == {("YUYV", 640, 480, fps) for fps in (30, 15)} | {("YUYV", 320, 240, fps) for fps in (60, 30)}
    await in_thread(capture.close)


async def test_each_sensor_sends_its_own_images_rotated_like_a_digit(emulator: DigitEmulator) -> None:
    for bus_id, level in (("1-1", 40), ("1-2", 160)):
        capture = await in_thread(lambda bus_id=bus_id: UsbCapture(f"{emulator.address}/{bus_id}"))
        await in_thread(lambda capture=capture: capture.configure(QVGA))
        await in_thread(capture.start)
        (frame, *_) = await frames(capture, 3)
        portrait = decode_yuyv(frame.data)
        assert portrait[5:15, 5:15].min() > 240, "the bright corner is at the top left again"
        assert abs(int(portrait[200, 120, 1]) - level) <= 4
        await in_thread(capture.close)


async def test_a_slow_host_receives_the_next_image(images: Path) -> None:
    emulator = DigitEmulator(DigitEmulator.Settings(port=0, images=images))
    camera = emulator.cameras["1-1"]
    answers = Answers()
    bulk = BulkInEndpoint(answers)
    streaming = asyncio.create_task(camera.stream(bulk))
    for number in range(6):
        bulk.ask(number, 1_000_000)  # one read at a time: between two of them the host waits for nothing
        for _ in range(1000):
            if len(answers.pieces) > number:
                break
            await asyncio.sleep(0.002)
    streaming.cancel()
    sent = [piece[2:] for _, piece in answers.pieces]
    assert len(sent) == 6
    assert all(a != b for a, b in pairwise(sent))


async def test_leds_are_logged_and_a_value_beyond_them_refused(emulator: DigitEmulator) -> None:
    capture = await in_thread(lambda: UsbCapture(f"{emulator.address}/1-2"))
    assert await in_thread(lambda: capture.set_control(ZOOM_ABSOLUTE, 0xF73)) == 0xF73
    (event,) = emulator.events("leds")
    assert (event["serial"], event["rgb"]) == ("D20002", [15, 7, 3])
    with pytest.raises(OSError, match="Broken pipe"):
        await in_thread(lambda: capture.set_control(ZOOM_ABSOLUTE, 0x1000))
    await in_thread(capture.close)


async def test_a_torn_image_has_its_first_rows_from_the_previous_one(emulator: DigitEmulator) -> None:
    capture = await in_thread(lambda: UsbCapture(f"{emulator.address}/1-1"))
    await in_thread(lambda: capture.configure(QVGA))
    await in_thread(capture.start)
    emulator.control("fault D20001.tear 4")
    taken = await frames(capture, 10)
    assert {one.damage for one in taken} == {None}
    torn = 0
    for one in taken:
        rows = np.frombuffer(one.data, np.uint8).reshape(240, 320, 2)[:, 100, 0].astype(int)
        steps = np.flatnonzero(np.diff(rows))
        assert len(steps) <= 1
        torn += len(steps)
    assert torn == 4
    await in_thread(capture.close)


async def test_a_fault_affects_one_sensor_or_all(emulator: DigitEmulator) -> None:
    captures = []
    for bus_id in ("1-1", "1-2"):
        capture = await in_thread(lambda bus_id=bus_id: UsbCapture(f"{emulator.address}/{bus_id}"))
        await in_thread(lambda capture=capture: capture.configure(QVGA))
        await in_thread(capture.start)
        captures.append(capture)
    for capture in captures:
        await frames(capture, 2)
    emulator.control("fault D20002.corrupt 3")
    assert {one.damage for one in await frames(captures[0], 6)} == {None}
    assert [one.damage for one in await frames(captures[1], 8)].count("the payload's error flag") == 3
    emulator.control("fault short 1")
    damages = [one.damage for capture in captures for one in await frames(capture, 8)]
    assert damages.count("76800 bytes instead of 153600") == 1
    emulator.control("fault D20001.unplug")
    with pytest.raises(OSError, match="No such device"):
        await frames(captures[0], 1000)
    assert await in_thread(lambda: listed(emulator.address)) == ["1-2"]
    assert len(await frames(captures[1], 3)) == 3
    emulator.control("clear")
    assert await in_thread(lambda: listed(emulator.address)) == ["1-1", "1-2"]
    for capture in captures:
        await in_thread(capture.close)


async def test_a_stream_can_be_restarted_in_the_middle_of_an_image(emulator: DigitEmulator) -> None:
    for _ in range(3):
        capture = await in_thread(lambda: UsbCapture(f"{emulator.address}/1-1"))
        await in_thread(lambda capture=capture: capture.configure(VideoMode("YUYV", 640, 480, 30.0)))
        await in_thread(capture.start)
        assert {one.damage for one in await frames(capture, 2)} == {None}
        await in_thread(capture.close)


class Answers:
    """What is written to a host, cut into answers."""

    def __init__(self) -> None:
        self.pieces: list[tuple[int, bytes]] = []

    def write(self, data: bytes) -> None:
        self.pieces.append((int.from_bytes(data[4:8], "big"), data[48:]))


async def test_the_rest_of_an_image_is_dropped_if_the_host_stops_reading() -> None:
    answers = Answers()
    bulk = BulkInEndpoint(answers)
    bulk.ask(1, 100)
    sending = asyncio.create_task(bulk.send(bytes(100) + bytes([1]) * 150, full=False))
    await asyncio.sleep(0)
    bulk.ask(2, 100)
    assert bulk.withdraw(2)
    bulk.ask(3, 100)
    await sending
    assert answers.pieces == [(1, bytes(100))]
    assert bulk.wanted, "read 3 waits for the next image"


async def test_a_payload_ends_with_a_short_packet_unless_it_has_the_negotiated_size() -> None:
    for full, answered in ((True, [100, 100]), (False, [100, 100, 0])):
        answers = Answers()
        bulk = BulkInEndpoint(answers)
        for number in range(4):
            bulk.ask(number, 100)
        await bulk.send(bytes(200), full=full)
        assert [len(piece) for _, piece in answers.pieces] == answered


async def test_stopping_while_a_host_is_attached_is_quiet(
    emulator: DigitEmulator, caplog: pytest.LogCaptureFixture
) -> None:
    device = await in_thread(lambda: UsbDevice(emulator.address, "1-1"))
    await emulator.stop()
    await asyncio.sleep(0.05)
    await in_thread(device.close)
    assert caplog.records == []


async def test_a_request_unlinked_before_it_was_sent_is_answered_once_it_arrives(
    emulator: DigitEmulator,
) -> None:
    def ask() -> list[tuple[int, int, int]]:
        with connected(emulator.address) as link:
            link.sendall(struct.pack(">HHI32s", 0x111, 0x8003, 0, b"1-1"))
            exactly(link, 8 + 312)
            link.sendall(struct.pack(">5II24x", 2, 12, 0, 0, 1, 11))  # take 11 back
            link.sendall(struct.pack(">5I", 1, 11, 0, 1, 1) + struct.pack(">Iiiii8x", 0, 512, 0, -1, 0))
            device = struct.pack("<BBHHH", 0x80, 6, 0x0100, 0, 18)
            link.sendall(struct.pack(">5I", 1, 13, 0, 1, 0) + struct.pack(">Iiiii8s", 0, 18, 0, -1, 0, device))
            answers = []
            for data_bytes in (0, 18):
                code, number, _, _, _, status, _ = struct.unpack(">5Iii20x", exactly(link, 48))
                exactly(link, data_bytes)
                answers.append((code, number, status))
            link.settimeout(0.2)
            with pytest.raises(TimeoutError):
                exactly(link, 1)
            return answers

    assert await in_thread(ask) == [(4, 12, -errno.ECONNRESET), (3, 13, 0)]


@pytest.mark.parametrize(
    ("settings", "expected"),
    [
        ({"images": "/nowhere"}, "is not a folder"),
        ({"object": "unicorn"}, "no object 'unicorn'"),
        ({"host": "203.0.113.1"}, "cannot listen on"),
    ],
)
async def test_invalid_settings_are_reported(settings: dict[str, object], expected: str) -> None:
    with pytest.raises(InputError, match=expected):
        await DigitEmulator(DigitEmulator.Settings.model_validate({"port": 0} | settings)).start()


@pytest.mark.parametrize("serials", [["D1", "D1"], ["D 1"], [""], []])
def test_invalid_serial_numbers(serials: list[str]) -> None:
    with pytest.raises(ValidationError):
        DigitEmulator.Settings(serial=serials)


async def test_an_unknown_fault_is_refused(emulator: DigitEmulator) -> None:
    with pytest.raises(CommandRefused, match=r"D20001\.stall"):
        emulator.control("fault D20009.stall")


async def test_garbage_ends_only_its_connection(emulator: DigitEmulator) -> None:
    host, port = emulator.address.split(":")
    for garbage in (b"", b"GET / HTTP/1.1\r\n\r\n", bytes(200), b"\x01\x11\x80\x03\0\0\0\0" + b"9-9".ljust(32, b"\0")):
        reader, writer = await asyncio.open_connection(host, int(port))
        writer.write(garbage)
        writer.write_eof()
        await asyncio.wait_for(reader.read(), 2.0)
        writer.close()
    assert await in_thread(lambda: listed(emulator.address)) == ["1-1", "1-2"]
