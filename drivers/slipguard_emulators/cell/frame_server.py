"""Serves one tactile sensor's frames on a Unix socket, to one client at a time as a camera does.

The wire format is documented in the driver `socket` (`slipguard_drivers/socket_camera.py`); the code here is separate,
so that the two check each other.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import struct
from collections.abc import Coroutine
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame, TactileSensor
from slipguard.errors import DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen

VERSION = 1
FRAME_HEAD = struct.Struct("<4sHHIdQ")
FRAME_MAGIC = b"SGF1"
SOCKET_MODE = 0o660
TORN_BYTES = 4
"""Number of pixel bytes in a damaged frame."""
LEAVING_S = 0.25
"""How long a new client waits for the previous one to disconnect."""
LINGER_S = 10.0
"""How long the sensor stays open after its client has left: starting it takes a while."""


def pack_greeting(serial: str, fps: float) -> bytes:
    """Return the line that opens a stream."""
    return json.dumps({"frames": VERSION, "serial": serial, "fps": fps}).encode() + b"\n"


def pack_refusal(reason: str) -> bytes:
    """Return the line that is sent instead of a stream."""
    return json.dumps({"error": reason}).encode() + b"\n"


def pack_frame(image: NDArray[np.uint8], captured_at_s: float, sequence: int) -> bytes:
    """Return one frame as bytes. image: (320, 240, 3) uint8 BGR."""
    height, width = image.shape[:2]
    return FRAME_HEAD.pack(FRAME_MAGIC, width, height, image.nbytes, captured_at_s, sequence) + image.tobytes()


class FrameServer:
    """Opens `sensor` for a client and sends its frames, faults included.

    A repeated image is sent as a new frame, a damaged one as a frame with too few pixels. Frames that arrive before the
    client has read the previous one are skipped. fps: rate in the greeting.
    """

    def __init__(self, path: Path, sensor: TactileSensor, fps: float) -> None:
        self.path = path
        self.sent = 0
        self._sensor = sensor
        self._fps = fps
        self._listening: socket.socket | None = None
        self._reader: asyncio.Task[None] | None = None
        self._lingering: asyncio.Task[None] | None = None
        self._last: Frame | None = None
        self._sequence = 0
        self._tasks: set[asyncio.Task[None]] = set()

    @property
    def plugged(self) -> bool:
        """Whether clients can connect."""
        return self._listening is not None

    @property
    def read(self) -> bool:
        """Whether a client is connected."""
        return self._reader is not None and not self._reader.done()

    def plug(self) -> None:
        """Create the socket. Idempotent. Raises OSError."""
        if self._listening is not None:
            return
        self.path.unlink(missing_ok=True)
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM | socket.SOCK_NONBLOCK)
        try:
            listening.bind(str(self.path))
            self.path.chmod(SOCKET_MODE)
            listening.listen(4)
        except BaseException:
            listening.close()
            raise
        self._listening = listening
        self._start(self._accept(listening), "accept")

    def unplug(self) -> None:
        """Remove the socket and disconnect, even in the middle of a frame. Idempotent."""
        if self._listening is None:
            return
        self._listening.close()
        self._listening = None
        self.path.unlink(missing_ok=True)
        for task in self._tasks:
            task.cancel()

    async def close(self) -> None:
        """Remove the socket and end all tasks."""
        self.unplug()
        while self._tasks:
            await asyncio.wait(self._tasks)
        await self._sensor.close()

    def _start(self, work: Coroutine[None, None, None], what: str) -> asyncio.Task[None]:
        task: asyncio.Task[None] = asyncio.create_task(work, name=f"{self.path.name}: {what}")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            connection, _ = await loop.sock_accept(listening)
            reader, writer = await asyncio.open_unix_connection(sock=connection)
            if self._reader is not None:
                await asyncio.wait([self._reader], timeout=LEAVING_S)
            if self.read:
                writer.write(pack_refusal("another program is reading this camera; stop it first"))
                writer.close()
            else:
                self._reader = self._start(self._serve(reader, writer), "reader")

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send until the client disconnects; it never sends anything."""
        if self._lingering is not None:
            self._lingering.cancel()
        hung_up = asyncio.create_task(reader.read(1), name=f"{self.path.name}: hung up")
        sending = asyncio.create_task(self._send(writer), name=f"{self.path.name}: frames")
        try:
            await asyncio.wait([hung_up, sending], return_when=asyncio.FIRST_COMPLETED)
        finally:
            hung_up.cancel()
            sending.cancel()
            await asyncio.gather(hung_up, sending, return_exceptions=True)
            writer.transport.abort()
            if self.plugged:
                self._lingering = self._start(self._linger(), "linger")
            else:
                await self._sensor.close()

    async def _linger(self) -> None:
        await asyncio.sleep(LINGER_S)
        await self._sensor.close()

    async def _send(self, writer: asyncio.StreamWriter) -> None:
        with contextlib.suppress(DeviceLost):
            writer.write(pack_greeting(self._sensor.serial, self._fps))
            await self._sensor.open()
            while True:
                now_s = asyncio.get_running_loop().time()
                try:
                    self._last = await self._sensor.next_frame()
                    self._sequence = max(self._sequence + 1, self._last.sequence)
                    packet = pack_frame(self._last.image, self._last.captured_at_s, self._sequence)
                except DeviceTimeout:
                    continue
                except FrameFrozen:
                    if self._last is None:
                        continue
                    self._sequence += 1
                    packet = pack_frame(self._last.image, now_s, self._sequence)
                except FrameCorrupt:
                    self._sequence += 1
                    torn = FRAME_HEAD.pack(
                        FRAME_MAGIC, FRAME_WIDTH_PX, FRAME_HEIGHT_PX, TORN_BYTES, now_s, self._sequence
                    )
                    packet = torn + bytes(TORN_BYTES)
                if writer.transport.get_write_buffer_size() == 0:
                    writer.write(packet)
                    self.sent += 1
