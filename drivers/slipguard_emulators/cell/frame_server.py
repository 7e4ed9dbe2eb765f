"""Serves one tactile sensor's frames on a Unix socket, to one client at a time as a camera does.

The wire format is documented in the driver `socket` (`slipguard_drivers/socket_camera.py`); the code here is separate,
so that the two check each other.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import struct
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame, TactileSensor
from slipguard.errors import DeviceLost, DeviceTimeout, FrameCorrupt, FrameFrozen
from slipguard_emulators.stream_server import Client, StreamServer

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


class FrameServer(StreamServer):
    """Opens `sensor` for a client and sends its frames, faults included.

    A repeated image is sent as a new frame, a damaged one as a frame with too few pixels. Frames that arrive before the
    client has read the previous one are skipped. fps: rate in the greeting.
    """

    def __init__(self, path: Path, sensor: TactileSensor, fps: float) -> None:
        super().__init__(path, self._take_turns)
        self.sent = 0
        self._sensor = sensor
        self._fps = fps
        self._free = asyncio.Event()
        """Whether no client is connected."""
        self._free.set()
        self._lingering: asyncio.Task[None] | None = None
        self._last: Frame | None = None
        self._sequence = 0

    @property
    def read(self) -> bool:
        """Whether a client is connected."""
        return not self._free.is_set()

    def plug(self) -> None:
        """Create the socket. Idempotent. Raises InputError."""
        super().plug()
        Path(self.path).chmod(SOCKET_MODE)

    async def close(self) -> None:
        """Remove the socket and end all tasks."""
        await super().close()
        await self._sensor.close()

    async def _take_turns(self, client: Client) -> None:
        reader, writer = client
        try:
            await asyncio.wait_for(self._free.wait(), LEAVING_S)
        except TimeoutError:
            writer.write(pack_refusal("another program is reading this camera; stop it first"))
            return
        self._free.clear()
        try:
            await self._serve_one(reader, writer)
        finally:
            self._free.set()

    async def _serve_one(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        """Send until the client disconnects; it never sends anything."""
        if self._lingering is not None:
            self._lingering.cancel()
        hung_up = asyncio.create_task(reader.read(1), name=f"{self.path}: hung up")
        sending = asyncio.create_task(self._send(writer), name=f"{self.path}: frames")
        try:
            await asyncio.wait([hung_up, sending], return_when=asyncio.FIRST_COMPLETED)
        finally:
            hung_up.cancel()
            sending.cancel()
            await asyncio.gather(hung_up, sending, return_exceptions=True)
            writer.transport.abort()
            if self.plugged:
                self._lingering = self._start(self._linger())
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
