"""Video capture directly from the kernel: ioctl, mmap, the kernel's capture time and sequence number.

Opening and configuring wait for USB; `take` blocks for microseconds only. To wait for a frame, wait for `fileno()` to
become readable.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass

from slipguard_drivers.digit import v4l2

BUFFERS = 8
"""At 60 frames per second, no frame is lost while the process is delayed by up to 0.12 s."""


@dataclass(frozen=True, slots=True)
class VideoMode:
    """One video mode. pixels: "YUYV" or "MJPG". fps: 0 if it is not known."""

    pixels: str
    width_px: int
    height_px: int
    fps: float

    def __str__(self) -> str:
        rate = f" at {self.fps:g} frames per second" if self.fps else ""
        return f"{self.width_px}x{self.height_px} {self.pixels}{rate}"


@dataclass(frozen=True, slots=True)
class RawFrame:
    """One frame as the camera driver delivers it. captured_at_s: None if its clock is not the monotonic one."""

    data: bytes
    sequence: int
    captured_at_s: float | None
    damage: str | None


class V4l2Capture:
    """One open capture device. Every method raises OSError, with ENODEV if the device is gone."""

    def __init__(self, path: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._maps: list[mmap.mmap] = []
        self._frame_bytes: int | None = None

    def fileno(self) -> int:
        """Return the descriptor: readable when a frame waits, permanently in error while no buffer is queued."""
        return self._fd

    def modes(self, width_px: int | None = None, height_px: int | None = None) -> list[VideoMode]:
        """Return every mode, or those of one size. Continuous ranges are left out for sizes and 0 for rates."""
        found = []
        for description in self._each(v4l2.ENUM_FMT, v4l2.FORMAT_DESCRIPTION, "index", v4l2.CAPTURE, 0, b"", 0):
            pixels = description[4]
            sizes = [(width_px, height_px)] if width_px and height_px else self._sizes(pixels)
            for width, height in sizes:
                found += [
                    VideoMode(v4l2.fourcc_name(pixels), width, height, fps)
                    for fps in self._rates(pixels, width, height)
                ]
        return found

    def configure(self, mode: VideoMode) -> VideoMode:
        """Set a mode, map the buffers, and return the actual mode: a camera driver may change the rate.

        Raises OSError EINVAL, with the reason, if it sets another size or pixel format.
        """
        raw = bytearray(
            v4l2.FORMAT.pack(v4l2.CAPTURE, mode.width_px, mode.height_px, v4l2.fourcc(mode.pixels), 1, *[0] * 8)
        )
        fcntl.ioctl(self._fd, v4l2.S_FMT, raw)
        _, width, height, number, _, stride, size, *_ = v4l2.FORMAT.unpack(raw)
        pixels = v4l2.fourcc_name(number)
        if (width, height, pixels) != (mode.width_px, mode.height_px, mode.pixels):
            raise OSError(errno.EINVAL, f"it sets {width}x{height} {pixels} instead of {mode}; check its firmware")
        packed = pixels == "YUYV"
        if packed and (stride, size) != (2 * width, 2 * width * height):
            raise OSError(errno.EINVAL, f"its rows have {stride} bytes and its frames {size}, not {2 * width} per row")
        self._frame_bytes = size if packed else None
        given = VideoMode(pixels, width, height, self._set_rate(mode.fps))
        self._map_buffers()
        return given

    def set_control(self, control: int, value: int) -> int:
        """Set a control and return its actual value. Raises OSError EINVAL if the device has no such control."""
        fcntl.ioctl(self._fd, v4l2.S_CTRL, v4l2.CONTROL.pack(control, value))
        raw = bytearray(v4l2.CONTROL.pack(control, 0))
        fcntl.ioctl(self._fd, v4l2.G_CTRL, raw)
        return int(v4l2.CONTROL.unpack(raw)[1])

    def start(self) -> None:
        """Queue every buffer and start the stream. Raises OSError ENOSPC if the bus has not enough bandwidth."""
        for index in range(len(self._maps)):
            fcntl.ioctl(self._fd, v4l2.QBUF, buffer(index))
        fcntl.ioctl(self._fd, v4l2.STREAMON, struct.pack("=I", v4l2.CAPTURE))

    def take(self) -> RawFrame | None:
        """Return a copy of the oldest waiting frame, or None. Its buffer is queued again at once."""
        raw = buffer(0)
        try:
            fcntl.ioctl(self._fd, v4l2.DQBUF, raw)
        except BlockingIOError:
            return None
        index, _, used, flags, _, seconds, micros, _, sequence, *_ = v4l2.BUFFER.unpack(raw)
        data = self._maps[index][:used]
        fcntl.ioctl(self._fd, v4l2.QBUF, raw)
        monotonic = flags & v4l2.TIMESTAMP_MASK == v4l2.TIMESTAMP_MONOTONIC
        damage = None
        if flags & v4l2.FLAG_ERROR:
            damage = f"{used} bytes with the camera driver's error flag"
        elif used != (self._frame_bytes or max(used, 1)):
            damage = f"{used} bytes instead of {self._frame_bytes or 'an image'}"
        return RawFrame(data, sequence, seconds + micros * 1e-6 if monotonic else None, damage)

    def close(self) -> None:
        """Stop the stream and close the device, which may be gone already. Idempotent."""
        if self._fd < 0:
            return
        with contextlib.suppress(OSError):  # not started, or unplugged: the buffers are freed in any case
            fcntl.ioctl(self._fd, v4l2.STREAMOFF, struct.pack("=I", v4l2.CAPTURE))
        for mapped in self._maps:
            mapped.close()
        self._maps.clear()
        os.close(self._fd)
        self._fd = -1

    def _each(self, code: int, layout: struct.Struct, *fields: object) -> Iterator[tuple[int, ...]]:
        """Yield all entries of an enumerating request; the field "index" counts up."""
        for index in range(64):
            raw = bytearray(layout.pack(*(index if field == "index" else field for field in fields)))
            try:
                fcntl.ioctl(self._fd, code, raw)
            except OSError as error:
                if error.errno in (errno.EINVAL, errno.ENOTTY):  # end of the list, or no such list
                    return
                raise
            yield layout.unpack(raw)

    def _sizes(self, pixels: int) -> list[tuple[int, int]]:
        sizes = self._each(v4l2.ENUM_FRAMESIZES, v4l2.FRAME_SIZE, "index", pixels, *[0] * 7)
        return [(one[3], one[4]) for one in sizes if one[2] == v4l2.DISCRETE]

    def _rates(self, pixels: int, width: int, height: int) -> list[float]:
        rates = self._each(v4l2.ENUM_FRAMEINTERVALS, v4l2.FRAME_INTERVAL, "index", pixels, width, height, *[0] * 7)
        return [one[6] / one[5] if one[4] == v4l2.DISCRETE and one[5] else 0.0 for one in rates]

    def _set_rate(self, fps: float) -> float:
        raw = bytearray(v4l2.STREAM_PARAMETERS.pack(v4l2.CAPTURE, 0, 0, 1000, round(1000 * fps)))
        fcntl.ioctl(self._fd, v4l2.S_PARM, raw)
        numerator, denominator = v4l2.STREAM_PARAMETERS.unpack(raw)[3:5]
        return float(denominator / numerator) if numerator else 0.0

    def _map_buffers(self) -> None:
        raw = bytearray(v4l2.BUFFER_REQUEST.pack(BUFFERS, v4l2.CAPTURE, v4l2.MEMORY_MMAP, 0))
        fcntl.ioctl(self._fd, v4l2.REQBUFS, raw)
        for index in range(v4l2.BUFFER_REQUEST.unpack(raw)[0]):
            about = buffer(index)
            fcntl.ioctl(self._fd, v4l2.QUERYBUF, about)
            unpacked = v4l2.BUFFER.unpack(about)
            offset, length = unpacked[10] & 0xFFFFFFFF, unpacked[11]
            self._maps.append(
                mmap.mmap(self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)
            )


def buffer(index: int) -> bytearray:
    """Return a request about one buffer, for the kernel to fill in."""
    return bytearray(v4l2.BUFFER.pack(index, v4l2.CAPTURE, 0, 0, 0, 0, 0, b"", 0, v4l2.MEMORY_MMAP, 0, 0, 0))
