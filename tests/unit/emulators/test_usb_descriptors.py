"""The emulated DIGIT's descriptors, byte by byte, compared with USB 2.0 (chapter 9) and the Video Class 1.0."""

from __future__ import annotations

import pytest

from slipguard_emulators.digit.usb_descriptors import (
    configuration_descriptor,
    device_descriptor,
    string_descriptor,
)


def pieces(data: bytes) -> list[bytes]:
    found, at = [], 0
    while at < len(data):
        assert data[at] >= 2, "every descriptor has a length and a type"
        found.append(data[at : at + data[at]])
        at += data[at]
    assert at == len(data), "the lengths add up"
    return found


def test_the_device_is_a_digit() -> None:
    assert device_descriptor(212) == bytes.fromhex("12 01 0002 ef0201 40 3328 0902 1202 01 02 03 01")
    assert device_descriptor(101)[12:14] == bytes.fromhex("0101"), "revision 1.01"


def test_strings() -> None:
    assert string_descriptor(0, "D20001") == bytes.fromhex("04 03 0904")
    assert string_descriptor(2, "D20001") == bytes.fromhex("0c 03 4400 4900 4700 4900 5400")
    assert string_descriptor(3, "D20001") == bytes.fromhex("0e 03 4400 3200 3000 3000 3000 3100")
    assert string_descriptor(4, "D20001") is None


@pytest.mark.parametrize("formats", [("YUYV",), ("MJPG",), ("YUYV", "MJPG")])
def test_the_total_lengths_match(formats: tuple[str, ...]) -> None:
    configuration = configuration_descriptor(formats)
    assert int.from_bytes(configuration[2:4], "little") == len(configuration)
    parts = pieces(configuration)
    assert [part[1] for part in parts[:3]] == [0x02, 0x0B, 0x04]
    control = next(index for index, part in enumerate(parts) if part[1:3] == b"\x24\x01")
    own = parts[control : next(i for i, part in enumerate(parts) if i > control and part[1] == 0x04)]
    assert int.from_bytes(own[0][5:7], "little") == sum(map(len, own)), "the control interface's header"
    streaming = next(i for i, part in enumerate(parts) if i > control and part[1:3] == b"\x24\x01")
    own = parts[streaming:-1]
    assert int.from_bytes(own[0][4:6], "little") == sum(map(len, own)), "the streaming interface's header"
    assert own[0][3] == len(formats)
    assert parts[-1] == bytes.fromhex("07 05 81 02 0002 00"), "bulk in, 512 bytes"


def test_the_camera_has_zoom_and_nothing_else() -> None:
    camera = next(part for part in pieces(configuration_descriptor(("YUYV",))) if part[1:3] == b"\x24\x02")
    assert camera == bytes.fromhex("11 24 02 01 0102 00 00 0000 0000 0000 02 0002")[: camera[0]]
    assert int.from_bytes(camera[15:17], "little") == 1 << 9


def test_the_formats_and_their_sizes() -> None:
    parts = pieces(configuration_descriptor(("YUYV", "MJPG")))
    yuyv = next(part for part in parts if part[1:3] == b"\x24\x04")
    assert yuyv == bytes.fromhex("1b 24 04 01 02 5955593200001000800000aa00389b71 10 01 00 00 00 00")
    mjpg = next(part for part in parts if part[1:3] == b"\x24\x06")
    assert mjpg == bytes.fromhex("0b 24 06 02 02 00 01 00 00 00 00")
    small = [part for part in parts if part[1:3] == b"\x24\x05"][1]
    assert small == (
        bytes.fromhex("22 24 05 02 00 4001 f000")
        + (153600 * 8 * 10**7 // 333333).to_bytes(4, "little")
        + (153600 * 8 * 10**7 // 166666).to_bytes(4, "little")
        + (153600).to_bytes(4, "little")
        + (166666).to_bytes(4, "little")
        + bytes([2])
        + (166666).to_bytes(4, "little")
        + (333333).to_bytes(4, "little")
    )
