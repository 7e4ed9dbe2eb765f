"""The USB video class of an emulated DIGIT: control requests, stream negotiation, payloads."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass

from slipguard_emulators.digit.usb_descriptors import (
    CAMERA_TERMINAL,
    CONTROL_INTERFACE,
    SIZES,
    STREAMING_INTERFACE,
    UNITS_A_SECOND,
    FrameSize,
    configuration_descriptor,
    device_descriptor,
    string_descriptor,
)

ZOOM_MAX = 0xFFF
PROBE = struct.Struct("<HBBIHHHHHII")
HEADER_BYTES = 2
END_OF_HEADER, ERROR, END_OF_FRAME = 0x80, 0x40, 0x02
SET_CUR, GET_CUR, GET_MIN, GET_MAX, GET_RES, GET_LEN, GET_INFO, GET_DEF = 0x01, 0x81, 0x82, 0x83, 0x84, 0x85, 0x86, 0x87
ZOOM, PROBE_CONTROL, COMMIT_CONTROL = 0x0B, 0x01, 0x02


@dataclass(frozen=True, slots=True)
class NegotiatedMode:
    """The result of probe and commit. interval: in units of 100 ns."""

    format_index: int
    size_index: int
    interval: int

    @property
    def size(self) -> FrameSize:
        """Size of the images."""
        return SIZES[self.size_index - 1]

    @property
    def interval_s(self) -> float:
        """Time between images."""
        return self.interval / UNITS_A_SECOND


class UvcDevice:
    """One DIGIT as seen over USB. note: called with the events that the host causes."""

    def __init__(self, serial: str, formats: tuple[str, ...], firmware: int, note: Callable[..., None]) -> None:
        self.serial = serial
        self.formats = formats
        self.firmware = firmware
        self.zoom = 0
        self.agreed = NegotiatedMode(1, 1, SIZES[0].intervals[0])
        self._probed = self.agreed
        self._note = note
        self._frame_id = 0

    @property
    def pixels(self) -> str:
        """Pixel format of the stream."""
        return self.formats[self.agreed.format_index - 1]

    def control(self, setup: bytes, data: bytes) -> bytes | None:
        """Execute a request on endpoint 0; return the data that it reads (empty for a write), None for a stall."""
        kind, request, value, index, length = struct.unpack("<BBHHH", setup)
        if kind == 0x80 and request == 0x06:
            described = self._descriptor(value >> 8, value & 0xFF)
            return None if described is None else described[:length]
        if kind & 0x60 == 0:
            return self._standard(kind, request, length)
        interface, entity, selector = index & 0xFF, index >> 8, value >> 8
        if (interface, entity) == (STREAMING_INTERFACE, 0) and selector in (PROBE_CONTROL, COMMIT_CONTROL):
            return self._negotiate(request, data, length, commit=selector == COMMIT_CONTROL)
        if (interface, entity, selector) == (CONTROL_INTERFACE, CAMERA_TERMINAL, ZOOM):
            return self._leds(request, data, length)
        return None

    def payload(self, image: bytes, *, damaged: bool = False) -> bytes:
        """Return one frame in its wire format: header and image."""
        self._frame_id ^= 1
        flags = END_OF_HEADER | END_OF_FRAME | self._frame_id | (ERROR if damaged else 0)
        return bytes([HEADER_BYTES, flags]) + image

    @property
    def payload_max_bytes(self) -> int:
        """Return the negotiated size: a payload of this size needs no short packet at its end."""
        return self.agreed.size.bytes_max + HEADER_BYTES

    def _descriptor(self, kind: int, index: int) -> bytes | None:
        if kind == 1:
            return device_descriptor(self.firmware)
        if kind == 2:
            return configuration_descriptor(self.formats)
        return string_descriptor(index, self.serial) if kind == 3 else None

    def _standard(self, kind: int, request: int, length: int) -> bytes | None:
        """Answer requests for status, configuration and alternate setting; there is one of each."""
        reads = {0x00: bytes(2), 0x08: b"\x01", 0x0A: b"\x00"}
        if kind & 0x80:
            return reads[request][:length] if request in reads else None
        return b""

    def _negotiate(self, request: int, data: bytes, length: int, *, commit: bool) -> bytes | None:
        if request == SET_CUR:
            if len(data) < PROBE.size:
                return None
            self._probed = self._nearest(*PROBE.unpack_from(data)[1:4])
            if commit:
                self.agreed = self._probed
                size = self.agreed.size
                rate_fps = round(1.0 / self.agreed.interval_s)
                self._note(
                    "mode",
                    serial=self.serial,
                    pixels=self.pixels,
                    size=f"{size.width_px}x{size.height_px}",
                    fps=rate_fps,
                )
            return b""
        if request in (GET_CUR, GET_MIN, GET_MAX, GET_DEF):
            probed = self._probed
            size_bytes = probed.size.bytes_max
            fields = (1, probed.format_index, probed.size_index, probed.interval, 0, 0, 0, 0, 0)
            return PROBE.pack(*fields, size_bytes, size_bytes + HEADER_BYTES)[:length]
        return {GET_LEN: struct.pack("<H", PROBE.size), GET_INFO: b"\x03"}.get(request)

    def _nearest(self, format_index: int, size_index: int, interval: int) -> NegotiatedMode:
        """Return the mode that is closest to the requested one."""
        format_index = format_index if 1 <= format_index <= len(self.formats) else 1
        size_index = size_index if 1 <= size_index <= len(SIZES) else 1
        size = SIZES[size_index - 1]
        wanted = interval or UNITS_A_SECOND // size.rates_fps[0]
        return NegotiatedMode(format_index, size_index, min(size.intervals, key=lambda one: abs(one - wanted)))

    def _leds(self, request: int, data: bytes, length: int) -> bytes | None:
        if request == SET_CUR:
            if len(data) < 2:
                return None
            value = int.from_bytes(data[:2], "little")
            if value > ZOOM_MAX:
                return None
            self.zoom = value
            self._note("leds", serial=self.serial, value=f"{value:#05x}", rgb=[value >> 8, value >> 4 & 15, value & 15])
            return b""
        words = {GET_CUR: self.zoom, GET_MIN: 0, GET_MAX: ZOOM_MAX, GET_RES: 1, GET_LEN: 2, GET_DEF: 0}
        if request == GET_INFO:
            return b"\x03"
        return struct.pack("<H", words[request])[:length] if request in words else None
