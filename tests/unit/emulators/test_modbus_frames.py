"""The manual's example session, byte for byte: the emulated gripper's side, and what our driver reads from it."""

from __future__ import annotations

import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from slipguard_drivers.robotiq.registers import FingerMotion, decode
from slipguard_emulators.robotiq import modbus_frames as frames

CLEAR = "09 10 03E8 0003 06 0000 0000 0000 7330"
ACTIVATE = "09 10 03E8 0003 06 0100 0000 0000 72E1"
CLOSE = "09 10 03E8 0003 06 0900 00FF FFFF 4229"
OPEN = "09 10 03E8 0003 06 0900 0000 FFFF 7219"
WRITTEN = "09 10 03E8 0003 0130"
ASK_ONE = "09 03 07D0 0001 85CF"
ASK_ALL = "09 03 07D0 0003 040E"
ASK_ALL_AS_INPUTS = "09 04 07D0 0003 B1CE"
NOT_YET_ACTIVE = "09 03 02 1100 55D5"
ACTIVE = "09 03 02 3100 4C15"
OPENING = "09 03 06 3900 0000 BB10 30E0"
OPENED = "09 03 06 F900 0000 0D00 564C"
GRASPED = "09 04 06 B900 00FF BD00 5C9A"
ALL = [CLEAR, ACTIVATE, CLOSE, OPEN, WRITTEN, ASK_ONE, ASK_ALL, ASK_ALL_AS_INPUTS, NOT_YET_ACTIVE, ACTIVE, OPENING]
ALL += [OPENED, GRASPED]


def parsed(text: str) -> frames.Request:
    request = frames.parse(bytes.fromhex(text))
    assert request is not None
    return request


def words(answer: str) -> list[int]:
    payload = bytes.fromhex(answer)[3:-2]
    return list(struct.unpack(f">{len(payload) // 2}H", payload))


@pytest.mark.parametrize("text", ALL)
def test_the_doubles_checksum_is_the_manuals(text: str) -> None:
    raw = bytes.fromhex(text)
    assert frames.crc16(raw[:-2]) == raw[-2:]


@pytest.mark.parametrize("text", [CLEAR, ACTIVATE, CLOSE, OPEN, ASK_ONE, ASK_ALL, ASK_ALL_AS_INPUTS])
def test_a_request_is_as_long_as_it_is(text: str) -> None:
    raw = bytes.fromhex(text)
    assert frames.frame_bytes(raw) == len(raw)
    assert all(frames.frame_bytes(raw[:cut]) in (None, len(raw)) for cut in range(len(raw)))
    assert parsed(text).makes_sense


@pytest.mark.parametrize("text", [CLEAR, ACTIVATE, CLOSE, OPEN])
def test_a_write_is_answered_as_in_the_manual(text: str) -> None:
    request = parsed(text)
    assert (request.write_at, request.values) == (0x03E8, struct.unpack(">3H", bytes.fromhex(text)[7:-2]))
    answer = frames.answer(request, lambda: [0, 0, 0])
    assert answer + frames.crc16(answer) == bytes.fromhex(WRITTEN)


@pytest.mark.parametrize(
    ("asked", "expected"),
    [
        (ASK_ONE, NOT_YET_ACTIVE),
        (ASK_ONE, ACTIVE),
        (ASK_ALL, OPENING),
        (ASK_ALL, OPENED),
        (ASK_ALL_AS_INPUTS, GRASPED),
    ],
)
def test_a_read_is_answered_as_in_the_manual(asked: str, expected: str) -> None:
    answer = frames.answer(parsed(asked), lambda: [*words(expected), 0, 0])
    assert answer + frames.crc16(answer) == bytes.fromhex(expected)


def test_the_manuals_responses_are_decoded() -> None:
    opening, opened, grasped = (decode(words(text)) for text in (OPENING, OPENED, GRASPED))
    assert (opening.motion, opening.position) == (FingerMotion.MOVING, 0xBB)
    assert (opened.motion, opened.position, opened.stopped_on_object) == (FingerMotion.AT_POSITION, 0x0D, False)
    assert (grasped.motion, grasped.position, grasped.stopped_on_object) == (FingerMotion.STOPPED_CLOSING, 0xBD, True)
    assert not decode([*words(NOT_YET_ACTIVE), 0, 0]).ready
    assert decode([*words(ACTIVE), 0, 0]).ready


def test_a_write_that_also_reads() -> None:
    body = bytes.fromhex("09 17 07D0 0003 03E8 0003 06 0900 00FF FFFF")
    request = frames.parse(body + frames.crc16(body))
    assert request is not None
    assert request.makes_sense
    assert (request.values, request.count) == ((0x0900, 0x00FF, 0xFFFF), 3)
    assert frames.answer(request, lambda: [1, 2, 3]) == bytes.fromhex("09 17 06 0001 0002 0003")


def test_a_single_register_is_written() -> None:
    body = bytes.fromhex("09 06 03E8 0100")
    request = frames.parse(body + frames.crc16(body))
    assert request is not None
    assert (request.write_at, request.values) == (0x03E8, (0x0100,))
    assert frames.answer(request, list) == body


@pytest.mark.parametrize(
    "body",
    [
        "09 04 07D0 0004",  # a register there is not
        "09 04 0000 0001",
        "09 04 07D0 0000",
        "09 10 03E7 0003 06 0900 0000 0000",
        "09 10 03EA 0002 04 0000 0000",
        "09 06 07D0 0000",
    ],
)
def test_requests_for_unknown_registers_are_recognized(body: str) -> None:
    raw = bytes.fromhex(body)
    request = frames.parse(raw + frames.crc16(raw))
    assert request is not None
    assert not request.makes_sense


def test_a_request_with_inconsistent_counts_is_ignored() -> None:
    raw = bytes.fromhex("09 10 03E8 0003 04 0900 0000")
    assert frames.parse(raw + frames.crc16(raw)) is None


@given(st.binary(max_size=40))
def test_noise_is_ignored(data: bytes) -> None:
    size = frames.frame_bytes(data)
    if size and len(data) >= size:
        request = frames.parse(data[:size])
        assert request is None or frames.crc16(data[: size - 2]) == data[size - 2 : size]
