"""A USB host and camera driver in user space, over USB/IP: what the kernel does with a DIGIT, without the kernel.

`UsbCapture` takes the place of the DIGIT driver's `Capture`. It reads descriptors and payloads by the letter of the
standards (USB 2.0, UVC 1.0, USB/IP 1.1.1) and shares nothing with the emulator it is tried against.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable

from slipguard_drivers.digit.capture import RawFrame, VideoMode

READ_BYTES = 16384
READS = 5
WAIT_S = 5.0
SET_CUR, GET_CUR, GET_LEN = 1, 0x81, 0x85
PROBE = struct.Struct("<HBBI10xII")


def gone() -> OSError:
    """What the kernel says of a device that was unplugged."""
    return OSError(errno.ENODEV, "No such device")


def connected(address: str) -> socket.socket:
    """A connection to host:port."""
    host, _, port = address.rpartition(":")
    return socket.create_connection((host, int(port)), WAIT_S)


def exactly(link: socket.socket, count: int) -> bytes:
    """Read exactly this number of bytes. Raises OSError ENODEV where the other end closes."""
    data = b""
    while len(data) < count:
        piece = link.recv(count - len(data))
        if not piece:
            raise gone()
        data += piece
    return data


def listed(address: str) -> list[str]:
    """Bus ids of the devices that a server exports."""
    with connected(address) as link:
        link.sendall(struct.pack(">HHI", 0x111, 0x8005, 0))
        _, code, status, count = struct.unpack(">HHII", exactly(link, 12))
        assert (code, status) == (5, 0)
        found = []
        for _ in range(count):
            about = exactly(link, 312)
            exactly(link, 4 * about[311])  # its interfaces
            found.append(about[256:288].rstrip(b"\0").decode())
        return found


class UsbDevice:
    """One imported device: control transfers, and reads from its streaming endpoint on a thread."""

    def __init__(self, address: str, bus_id: str) -> None:
        self._link = connected(address)
        self._link.sendall(struct.pack(">HHI32s", 0x111, 0x8003, 0, bus_id.encode()))
        _, code, status = struct.unpack(">HHI", exactly(self._link, 8))
        assert code == 3
        if status != 0:
            self._link.close()
            raise OSError(errno.EBUSY, "Device or resource busy")
        bus, device = struct.unpack_from(">II", exactly(self._link, 312), 288)
        self._id = bus << 16 | device
        self._link.settimeout(None)
        self._number = 0
        self._answers: dict[int, bytes | None] = {}
        self._news = threading.Condition()
        self._controls: dict[int, bool] = {}
        self.reads: set[int] = set()
        self.gone = False
        self.on_stream: Callable[[bytes, bool], None] = lambda data, short: None
        self.on_gone: Callable[[], None] = lambda: None
        self._thread = threading.Thread(target=self._listen, name=f"usb {bus_id}")
        self._thread.start()

    def control(self, kind: int, request: int, value: int, index: int, data: bytes | int) -> bytes:
        """A control transfer; data: what to write, or how much to read. OSError EPIPE for a stall, ENODEV."""
        length = data if isinstance(data, int) else len(data)
        setup = struct.pack("<BBHHH", kind, request, value, index, length)
        number = self._submit(0, setup, length, data)
        with self._news:
            assert self._news.wait_for(lambda: number in self._answers or self.gone, WAIT_S), "no answer"
            if number not in self._answers:
                raise gone()
            answer = self._answers.pop(number)
        if answer is None:
            raise OSError(errno.EPIPE, "Broken pipe")
        return answer

    def read_stream(self) -> None:
        """Ask for the next piece of the stream."""
        self._submit(1, bytes(8), READ_BYTES, READ_BYTES)

    def close(self) -> None:
        """Take back what was asked for, and release."""
        try:
            for number in list(self.reads):
                self._link.sendall(struct.pack(">5II24x", 2, self._next(), self._id, 0, 1, number))
            self._link.shutdown(socket.SHUT_RDWR)
        except OSError:
            pass  # gone already
        self._thread.join(WAIT_S)
        self._link.close()

    def _next(self) -> int:
        self._number += 1
        return self._number

    def _submit(self, endpoint: int, setup: bytes, length: int, data: bytes | int) -> int:
        number, is_read = self._next(), isinstance(data, int)
        (self.reads.add(number) if endpoint else self._controls.update({number: is_read}))
        head = struct.pack(">5I", 1, number, self._id, int(is_read), endpoint)
        try:
            self._link.sendall(
                head + struct.pack(">Iiiii8s", 0, length, 0, -1, 0, setup) + (b"" if isinstance(data, int) else data)
            )
        except OSError:
            raise gone() from None
        return number

    def _listen(self) -> None:
        """Sort what comes back until nothing does."""
        try:
            while True:
                code, number, _, _, _, status, length = struct.unpack(">5Iii20x", exactly(self._link, 48))
                if code == 4:  # taken back
                    self.reads.discard(number)
                elif number in self.reads:
                    self.reads.discard(number)
                    self.on_stream(exactly(self._link, length), length < READ_BYTES)
                else:
                    # What was written is counted in the answer, but does not come back.
                    data = exactly(self._link, length) if self._controls.pop(number) and length else b""
                    with self._news:
                        self._answers[number] = data if status == 0 else None
                        self._news.notify_all()
        except OSError:
            with self._news:
                self.gone = True
                self._news.notify_all()
            self.on_gone()


def descriptors(data: bytes) -> list[bytes]:
    """A configuration cut into its descriptors."""
    found, at = [], 0
    while at < len(data):
        found.append(data[at : at + data[at]])
        at += data[at]
    return found


def modes_of(configuration: bytes) -> dict[VideoMode, tuple[int, int, int]]:
    """Every mode of a camera with the format index, frame index and interval that ask for it."""
    found: dict[VideoMode, tuple[int, int, int]] = {}
    format_index, pixels = 0, ""
    for one in descriptors(configuration):
        kind = (one[1], one[2]) if len(one) > 2 else (one[1], 0)
        if kind in ((0x24, 0x04), (0x24, 0x06)) and len(one) in (27, 11):
            format_index, pixels = one[3], "MJPG" if one[2] == 6 else one[5:9].replace(b"YUY2", b"YUYV").decode()
        elif kind in ((0x24, 0x05), (0x24, 0x07)) and format_index:
            width, height = struct.unpack_from("<HH", one, 5)
            for interval in struct.unpack_from(f"<{one[25]}I", one, 26):
                fps = round(1e7 / interval, 2)
                found[VideoMode(pixels, width, height, round(fps, 1))] = (format_index, one[3], interval)
    return found


class UsbCapture:
    """A camera at "host:port/bus id", used like `slipguard_drivers.digit.capture.V4l2Capture`."""

    def __init__(self, path: str) -> None:
        self._device = UsbDevice(*path.split("/"))
        self._modes = modes_of(self._device.control(0x80, 6, 0x0200, 0, 4096))
        self._frame_bytes = self._payload_bytes = 0
        self._packed = True
        self._payload = b""
        self._begun_s = 0.0
        self._sequence = 0
        self._queue: deque[RawFrame] = deque()
        self._out, self._in = os.pipe()
        os.set_blocking(self._out, False)
        self._device.on_gone = self._ring

    def fileno(self) -> int:
        return self._out

    def modes(self, width_px: int | None = None, height_px: int | None = None) -> list[VideoMode]:
        return [one for one in self._modes if width_px in (None, one.width_px) and height_px in (None, one.height_px)]

    def configure(self, mode: VideoMode) -> VideoMode:
        asked = self._modes[mode]
        self._device.control(0x21, SET_CUR, 0x0100, 1, PROBE.pack(1, *asked, 0, 0))
        probed = self._device.control(0xA1, GET_CUR, 0x0100, 1, 26)
        _, *agreed, self._frame_bytes, self._payload_bytes = PROBE.unpack(probed)
        assert tuple(agreed) == asked
        self._device.control(0x21, SET_CUR, 0x0200, 1, probed)
        self._packed = mode.pixels == "YUYV"
        return mode

    def set_control(self, control: int, value: int) -> int:
        self._device.control(0x21, SET_CUR, 0x0B00, 0x0100, struct.pack("<H", value))
        return int.from_bytes(self._device.control(0xA1, GET_CUR, 0x0B00, 0x0100, 2), "little")

    def start(self) -> None:
        self._device.on_stream = self._on_stream
        for _ in range(READS):
            self._device.read_stream()

    def take(self) -> RawFrame | None:
        if self._queue:
            return self._queue.popleft()
        if self._device.gone:
            raise gone()
        try:
            os.read(self._out, 4096)
        except BlockingIOError:
            return None
        return self._queue.popleft() if self._queue else None

    def close(self) -> None:
        self._device.close()
        os.close(self._out)
        os.close(self._in)

    def _ring(self) -> None:
        os.write(self._in, b"!")

    def _on_stream(self, data: bytes, short: bool) -> None:
        """Put pieces together to payloads, which here are frames; on the device's thread."""
        self._device.read_stream()
        if not self._payload:
            self._begun_s = time.monotonic()
        self._payload += data
        if not short and len(self._payload) < self._payload_bytes:
            return
        payload, self._payload = self._payload, b""
        header, flags = payload[0], payload[1]
        image = payload[header:]
        assert flags & 0x82 == 0x82, "a header's end and a frame's end"
        damage = "the payload's error flag" if flags & 0x40 else None
        if self._packed and len(image) != self._frame_bytes:
            damage = f"{len(image)} bytes instead of {self._frame_bytes}"
        self._queue.append(RawFrame(image, self._sequence, self._begun_s, damage))
        self._sequence += 1
        self._ring()
