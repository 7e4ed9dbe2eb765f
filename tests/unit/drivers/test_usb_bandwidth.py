"""What the cameras on a USB bus reserve, by their descriptors and the kernel's /sys."""

from __future__ import annotations

import struct
from pathlib import Path

import pytest

from slipguard.diagnosis import CheckStatus
from slipguard_drivers.digit.diagnostics import check_bandwidth
from slipguard_drivers.digit.discovery import DigitDevice
from slipguard_drivers.digit.stream_setup import DigitSettings
from slipguard_drivers.digit.usb_bandwidth import reserved_bytes, stream_sizes

UVC_SIZES = (0x0080, 0x0200, 0x0400, 0x0B00, 0x0C00, 0x1380, 0x1400)
"""wMaxPacketSize of the alternate settings of a usual camera: 128 to 3 x 1024 bytes."""
BYTES = {1: 128, 2: 512, 3: 1024, 4: 2 * 768, 5: 2 * 1024, 6: 3 * 896, 7: 3 * 1024}


def descriptors(sizes: tuple[int, ...], *, isochronous: bool = True) -> bytes:
    """A device, its control interface, a microphone, and the alternate settings of its video stream."""
    out = bytes([18, 1]) + bytes(16) + bytes([9, 2]) + bytes(7)
    out += bytes([9, 4, 0, 0, 1, 0x0E, 1, 0, 0, 7, 5, 0x83, 3, 16, 0, 6])
    out += bytes([9, 4, 3, 1, 1, 0x01, 2, 0, 0, 7, 5, 0x84, 5]) + struct.pack("<HB", 200, 4)
    for alternate, size in enumerate((0, *sizes) if isochronous else sizes):
        out += bytes([9, 4, 1, alternate, 1, 0x0E, 2, 0, 0])
        if size:
            out += bytes([7, 5, 0x81, 5 if isochronous else 2]) + struct.pack("<HB", size, 1)
    return out


def bus(folder: Path, **cameras: int) -> Path:
    """/sys/bus/usb/devices with cameras by port (a for 1-1), each with its present alternate setting."""
    for letter, alternate in cameras.items():
        port = f"1-{ord(letter) - ord('a') + 1}"
        interface = folder / port / f"{port}:1.1"
        interface.mkdir(parents=True)
        (folder / port / "descriptors").write_bytes(descriptors(UVC_SIZES))
        (interface / "bInterfaceClass").write_text("0e\n")
        (interface / "bAlternateSetting").write_text(f"{alternate:2d}\n")
    return folder


def test_the_sizes_are_those_of_the_video_streams_alternate_settings() -> None:
    assert stream_sizes(descriptors(UVC_SIZES)) == BYTES
    assert stream_sizes(descriptors((0x0200,), isochronous=False)) == {}
    for cut in range(len(descriptors(UVC_SIZES))):
        stream_sizes(descriptors(UVC_SIZES)[:cut])


@pytest.mark.parametrize(
    ("bytes_s", "size"), [(320 * 240 * 2 * 60, 2 * 768), (320 * 240 * 2 * 30, 1024), (1e6, 512), (1e9, 3 * 1024)]
)
def test_a_stream_reserves_the_smallest_size_that_carries_it(bytes_s: float, size: int) -> None:
    assert reserved_bytes(BYTES, bytes_s) == size


@pytest.mark.parametrize(
    ("cameras", "settings", "status", "words"),
    [
        ({"a": 0}, {}, CheckStatus.OK, ["not shared", "26%"]),
        ({"a": 0, "b": 0}, {}, CheckStatus.OK, ["shared with D20002", "51%"]),
        ({"a": 0, "b": 0, "c": 4}, {}, CheckStatus.OK, ["a camera at port 1-3", "77%"]),
        ({"a": 0, "b": 0, "c": 0}, {}, CheckStatus.PROBLEM, ["102%", "another USB controller", "fps = 30"]),
        ({"a": 0, "b": 0, "c": 0}, {"fps": 30}, CheckStatus.OK, ["85%"]),
        ({"a": 0, "b": 0, "c": 0, "d": 0}, {}, CheckStatus.PROBLEM, ["154%", 'set pixels = "MJPG"']),
    ],
)
def test_the_doctor_adds_up_what_the_cameras_reserve(
    tmp_path: Path, cameras: dict[str, int], settings: dict[str, object], status: CheckStatus, words: list[str]
) -> None:
    digits = [DigitDevice(Path("/dev/video0"), f"D2000{n}", 212, f"1-{n}", 480.0) for n in (1, 2)]
    wanted = DigitSettings.model_validate({"serial": "D20001", **settings})
    result = check_bandwidth(digits[0], digits[: len(cameras)], wanted, bus(tmp_path, **cameras))
    assert result.status is status
    for word in words:
        assert word in f"{result.observed}; {result.action}"
