"""Video4Linux2 capture with nothing between us and the kernel: ioctl, mmap, kernel time and sequence number.

Structures and numbers from <linux/videodev2.h>, 64-bit layout. Everything here blocks for microseconds only; whoever
wants to wait does so on `fileno()`.
"""

from __future__ import annotations

import contextlib
import errno
import fcntl
import mmap
import os
import struct
from dataclasses import dataclass

FORMAT = struct.Struct("=I4x12I152x")
FORMAT_DESCRIPTION = struct.Struct("=III32sI16x")
STREAM_PARAMETERS = struct.Struct("=I4I184x")
BUFFER_REQUEST = struct.Struct("=IIII4x")
BUFFER = struct.Struct("=5I4xqq16sIIQII8x")
CONTROL = struct.Struct("=Ii")

CAPTURE = 1
MEMORY_MMAP = 1
FLAG_ERROR = 0x40
TIMESTAMP_MASK, TIMESTAMP_MONOTONIC = 0xE000, 0x2000
ZOOM_ABSOLUTE = 0x009A090D
BUFFERS = 4

_WRITE, _READ = 1, 2


def request_code(direction: int, number: int, size: int) -> int:
    """An ioctl number of the V4L2 family, as <asm-generic/ioctl.h> composes it."""
    return direction << 30 | size << 16 | ord("V") << 8 | number


ENUM_FMT = request_code(_READ | _WRITE, 2, FORMAT_DESCRIPTION.size)
S_FMT = request_code(_READ | _WRITE, 5, FORMAT.size)
REQBUFS = request_code(_READ | _WRITE, 8, BUFFER_REQUEST.size)
QUERYBUF = request_code(_READ | _WRITE, 9, BUFFER.size)
QBUF = request_code(_READ | _WRITE, 15, BUFFER.size)
DQBUF = request_code(_READ | _WRITE, 17, BUFFER.size)
STREAMON = request_code(_WRITE, 18, 4)
STREAMOFF = request_code(_WRITE, 19, 4)
S_PARM = request_code(_READ | _WRITE, 22, STREAM_PARAMETERS.size)
S_CTRL = request_code(_READ | _WRITE, 28, CONTROL.size)


def fourcc(name: str) -> int:
    """The number of a pixel format such as "YUYV"."""
    return int(struct.unpack("<I", name.encode("ascii"))[0])


def fourcc_name(number: int) -> str:
    """The name of a pixel format, for messages."""
    return struct.pack("<I", number).decode("ascii", "replace").rstrip()


@dataclass(frozen=True, slots=True)
class Delivery:
    """One frame as the driver delivered it. captured_at_s: None where the driver's clock is not monotonic."""

    data: bytes
    sequence: int
    captured_at_s: float | None
    damaged: bool


class Capture:
    """One open capture device with its buffers mapped.

    Raises OSError: ENODEV when the device is gone, EINVAL (with the reason) when it cannot deliver what is asked.
    """

    def __init__(self, path: str, width: int, height: int, fps: int, pixels: str) -> None:
        self._fd = os.open(path, os.O_RDWR | os.O_NONBLOCK | os.O_CLOEXEC)
        self._maps: list[mmap.mmap] = []
        try:
            self.frame_bytes = self._set_format(width, height, pixels)
            self._set_rate(fps)
            self._map_buffers()
        except BaseException:
            self.close()
            raise

    def fileno(self) -> int:
        """Readable when a frame waits, and in error for ever when no buffer is queued."""
        return self._fd

    def set_control(self, control: int, value: int) -> None:
        """Set a control. OSError EINVAL where the device has no such control, ERANGE beyond its range."""
        fcntl.ioctl(self._fd, S_CTRL, CONTROL.pack(control, value))

    def start(self) -> None:
        """Queue every buffer and let the frames come."""
        for index in range(len(self._maps)):
            fcntl.ioctl(self._fd, QBUF, _buffer(index))
        fcntl.ioctl(self._fd, STREAMON, struct.pack("=I", CAPTURE))

    def take(self) -> Delivery | None:
        """The oldest frame that waits, copied, or None. Its buffer is queued again at once."""
        raw = _buffer(0)
        try:
            fcntl.ioctl(self._fd, DQBUF, raw)
        except BlockingIOError:
            return None
        index, _, used, flags, _, seconds, micros, _, sequence, *_ = BUFFER.unpack(raw)
        data = self._maps[index][: min(used, self.frame_bytes)]
        fcntl.ioctl(self._fd, QBUF, raw)
        return Delivery(
            data=data,
            sequence=sequence,
            captured_at_s=seconds + micros * 1e-6 if flags & TIMESTAMP_MASK == TIMESTAMP_MONOTONIC else None,
            damaged=bool(flags & FLAG_ERROR) or used != self.frame_bytes,
        )

    def close(self) -> None:
        """Stop the stream and let go of the device, which may be gone already. Idempotent."""
        if self._fd < 0:
            return
        with contextlib.suppress(OSError):  # never started, or unplugged: the buffers are given back either way
            fcntl.ioctl(self._fd, STREAMOFF, struct.pack("=I", CAPTURE))
        for mapped in self._maps:
            mapped.close()
        self._maps.clear()
        os.close(self._fd)
        self._fd = -1

    def formats(self) -> list[str]:
        """Pixel formats the device offers."""
        found: list[str] = []
        while True:
            raw = bytearray(FORMAT_DESCRIPTION.pack(len(found), CAPTURE, 0, b"", 0))
            try:
                fcntl.ioctl(self._fd, ENUM_FMT, raw)
            except OSError:
                return found
            found.append(fourcc_name(FORMAT_DESCRIPTION.unpack(raw)[4]))

    def _set_format(self, width: int, height: int, pixels: str) -> int:
        """Ask for a format, check what was given (a driver may change anything); return the bytes of a frame."""
        raw = bytearray(FORMAT.pack(CAPTURE, width, height, fourcc(pixels), 1, *[0] * 8))
        fcntl.ioctl(self._fd, S_FMT, raw)
        _, got_width, got_height, got_pixels, _, stride, size, *_ = FORMAT.unpack(raw)
        if (got_width, got_height, fourcc_name(got_pixels)) != (width, height, pixels) or stride * height != size:
            raise OSError(
                errno.EINVAL,
                f"it gives {got_width}x{got_height} {fourcc_name(got_pixels)} (stride {stride}, {size} bytes) instead "
                f"of {width}x{height} {pixels}; it offers {', '.join(self.formats()) or 'no format'}",
            )
        return int(size)

    def _set_rate(self, fps: int) -> None:
        raw = bytearray(STREAM_PARAMETERS.pack(CAPTURE, 0, 0, 1, fps))
        fcntl.ioctl(self._fd, S_PARM, raw)
        numerator, denominator = STREAM_PARAMETERS.unpack(raw)[3:5]
        if numerator == 0 or abs(denominator / numerator - fps) > 0.5:
            raise OSError(errno.EINVAL, f"it gives {denominator}/{numerator} frames a second instead of {fps}")

    def _map_buffers(self) -> None:
        raw = bytearray(BUFFER_REQUEST.pack(BUFFERS, CAPTURE, MEMORY_MMAP, 0))
        fcntl.ioctl(self._fd, REQBUFS, raw)
        for index in range(BUFFER_REQUEST.unpack(raw)[0]):
            description = _buffer(index)
            fcntl.ioctl(self._fd, QUERYBUF, description)
            unpacked = BUFFER.unpack(description)
            offset, length = unpacked[10] & 0xFFFFFFFF, unpacked[11]
            self._maps.append(
                mmap.mmap(self._fd, length, mmap.MAP_SHARED, mmap.PROT_READ | mmap.PROT_WRITE, offset=offset)
            )


def _buffer(index: int) -> bytearray:
    return bytearray(BUFFER.pack(index, CAPTURE, 0, 0, 0, 0, 0, b"", 0, MEMORY_MMAP, 0, 0, 0))
