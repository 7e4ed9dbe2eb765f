"""The USB descriptors of a DIGIT, a video camera (USB 2.0 chapter 9, UVC 1.0).

It streams in bulk on one alternate setting, because USB/IP has no isochronous clock. All else is as in the real sensor:
identity, sizes, rates, and the zoom control that sets its LEDs.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

VENDOR_ID, PRODUCT_ID = 0x2833, 0x0209
MANUFACTURER, PRODUCT = "Facebook", "DIGIT"
ENDPOINT = 0x81
PACKET_BYTES = 512
CAMERA_TERMINAL, OUTPUT_TERMINAL = 1, 2
CONTROL_INTERFACE, STREAMING_INTERFACE = 0, 1
ZOOM_ABSOLUTE_BIT = 1 << 9
CLOCK_HZ = 48_000_000
UNITS_A_SECOND = 10_000_000
"""Frame intervals are counted in 100 ns."""
YUYV_GUID = bytes.fromhex("5955593200001000800000aa00389b71")


@dataclass(frozen=True, slots=True)
class FrameSize:
    """One supported size and its rates; the first rate is the default."""

    width_px: int
    height_px: int
    rates_fps: tuple[int, ...]

    @property
    def bytes_max(self) -> int:
        """Size of one uncompressed image."""
        return self.width_px * self.height_px * 2

    @property
    def intervals(self) -> list[int]:
        """Frame intervals in units of 100 ns, shortest first as the class requires."""
        return sorted(UNITS_A_SECOND // rate for rate in self.rates_fps)


SIZES = (FrameSize(640, 480, (30, 15)), FrameSize(320, 240, (60, 30)))


def device_descriptor(firmware: int) -> bytes:
    """Return 18 bytes. firmware: 212 is revision 2.12."""
    release = int(str(firmware), 16)
    return _sized(1, struct.pack("<HBBBBHHHBBBB", 0x0200, 0xEF, 2, 1, 64, VENDOR_ID, PRODUCT_ID, release, 1, 2, 3, 1))


def string_descriptor(index: int, serial: str) -> bytes | None:
    """Return the string (language, manufacturer, product or serial); None if the index is unknown."""
    texts = {1: MANUFACTURER, 2: PRODUCT, 3: serial}
    if index == 0:
        return _sized(3, struct.pack("<H", 0x0409))
    return _sized(3, texts[index].encode("utf-16-le")) if index in texts else None


def configuration_descriptor(formats: tuple[str, ...]) -> bytes:
    """Return the only configuration. formats: "YUYV", "MJPG", in the order of their format index."""
    control = _control_interface()
    streaming = _streaming_interface(formats)
    association = _sized(0x0B, bytes([CONTROL_INTERFACE, 2, 0x0E, 0x03, 0, 0]))
    body = association + control + streaming
    return _sized(2, struct.pack("<HBBBBB", 9 + len(body), 2, 1, 0, 0x80, 250)) + body


def _control_interface() -> bytes:
    """Return the interface with camera input, stream output, and zoom as the only control."""
    controls = struct.pack("<H", ZOOM_ABSOLUTE_BIT)
    camera = _video(0x02, struct.pack("<BHBBHHHB", CAMERA_TERMINAL, 0x0201, 0, 0, 0, 0, 0, len(controls)) + controls)
    output = _video(0x03, struct.pack("<BHBBB", OUTPUT_TERMINAL, 0x0101, 0, CAMERA_TERMINAL, 0))
    units = camera + output
    header = _video(0x01, struct.pack("<HHIBB", 0x0100, 13 + len(units), CLOCK_HZ, 1, STREAMING_INTERFACE))
    return _sized(4, bytes([CONTROL_INTERFACE, 0, 0, 0x0E, 0x01, 0, 0])) + header + units


def _streaming_interface(formats: tuple[str, ...]) -> bytes:
    described = b"".join(_format(index, name) for index, name in enumerate(formats, 1))
    header = _video(
        0x01,
        struct.pack(
            "<BHBBBBBBB", len(formats), 13 + len(formats) + len(described), ENDPOINT, 0, OUTPUT_TERMINAL, 0, 0, 0, 1
        )
        + bytes(len(formats)),
    )
    interface = _sized(4, bytes([STREAMING_INTERFACE, 0, 1, 0x0E, 0x02, 0, 0]))
    endpoint = _sized(5, struct.pack("<BBHB", ENDPOINT, 2, PACKET_BYTES, 0))
    return interface + header + described + endpoint


def _format(index: int, name: str) -> bytes:
    """Return a pixel format, its sizes and its colors (BT.601)."""
    if name == "YUYV":
        head = _video(0x04, bytes([index, len(SIZES)]) + YUYV_GUID + bytes([16, 1, 0, 0, 0, 0]))
        frame_kind = 0x05
    else:
        head = _video(0x06, bytes([index, len(SIZES), 0, 1, 0, 0, 0, 0]))
        frame_kind = 0x07
    frames = b"".join(_frame(frame_kind, number, size) for number, size in enumerate(SIZES, 1))
    return head + frames + _video(0x0D, bytes([1, 1, 4]))


def _frame(kind: int, number: int, size: FrameSize) -> bytes:
    intervals = size.intervals
    bits = [size.bytes_max * 8 * UNITS_A_SECOND // interval for interval in (intervals[-1], intervals[0])]
    default = UNITS_A_SECOND // size.rates_fps[0]
    fixed = struct.pack(
        "<BBHHIIIIB", number, 0, size.width_px, size.height_px, *bits, size.bytes_max, default, len(intervals)
    )
    return _video(kind, fixed + struct.pack(f"<{len(intervals)}I", *intervals))


def _video(kind: int, body: bytes) -> bytes:
    """Return a class-specific interface descriptor."""
    return _sized(0x24, bytes([kind]) + body)


def _sized(kind: int, body: bytes) -> bytes:
    """Return a descriptor, which begins with its length and its type."""
    return bytes([len(body) + 2, kind]) + body
