"""Driver `socket`: a tactile camera that another process serves on a Unix socket.

For cameras that another process owns: the emulated cell's, or a bridge to hardware that Python should not touch.
Wire format: one greeting line, then one frame after the other.

The greeting is a line of JSON, `{"frames": 1, "serial": "SIM-L", "fps": 60.0}`; a server that refuses sends
`{"error": reason}` and closes the connection. A frame is a header of 28 bytes, little endian, followed by its pixels:
rows from top to bottom, B, G, R for each pixel.

    magic "SGF1", width u16, height u16, bytes of pixels u32,
    captured at f64 (seconds of CLOCK_MONOTONIC), sequence u64

Both processes run on one machine, so they read the same clock. The server skips frames that the client is too slow to
read; the sequence numbers count them all.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import struct
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slipguard.cancellation import cancel_and_wait
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_SHAPE, FRAME_WIDTH_PX, DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceLost
from slipguard.frame_stream import FrameStream

HEADER = struct.Struct("<4sHHIdQ")
MAGIC = b"SGF1"
PIXEL_BYTES = FRAME_WIDTH_PX * FRAME_HEIGHT_PX * 3
PIXEL_BYTES_MAX = 4 * PIXEL_BYTES
"""A header that announces more bytes than this is not a header: the client has lost its position in the stream."""
GREETING_TIMEOUT_S = 2.0
GREETING_MAX_BYTES = 1024
VERSION = 1


class FrameStreamError(Exception):
    """The bytes are not a stream of frames, or not of this version; str() says what was received."""


class FrameGreeting(BaseModel):
    """Who sends the frames. fps: the rate that the server asked its camera for."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    frames: int
    serial: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    fps: Annotated[float, Field(gt=0.0, le=1000.0)]


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """The header of one frame."""

    width_px: int
    height_px: int
    pixel_bytes: int
    captured_at_s: float
    sequence: int

    @property
    def damage(self) -> str | None:
        """Why the frame cannot be used; None if it can."""
        if (self.width_px, self.height_px, self.pixel_bytes) != (FRAME_WIDTH_PX, FRAME_HEIGHT_PX, PIXEL_BYTES):
            return (
                f"{self.pixel_bytes} bytes for {self.width_px} x {self.height_px} pixels instead of {PIXEL_BYTES} "
                f"for {FRAME_WIDTH_PX} x {FRAME_HEIGHT_PX}"
            )
        return None if math.isfinite(self.captured_at_s) else f"captured at {self.captured_at_s} s"


class SocketCameraSettings(BaseModel):
    """path: the server's Unix socket."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    only_one: ClassVar = ("path",)
    path: Path
    stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0


class SocketSensor(TactileSensor):
    """Read the frames of one frame server."""

    Settings = SocketCameraSettings

    def __init__(self, settings: SocketCameraSettings, context: DriverContext) -> None:
        self._name = context.name
        self._settings = settings
        self._greeting: FrameGreeting | None = None
        self._stream: FrameStream | None = None
        self._reading: asyncio.Task[None] | None = None
        self._writer: asyncio.StreamWriter | None = None

    @property
    def serial(self) -> str:
        """Serial number from the server's greeting; empty before the first `open()`."""
        return self._greeting.serial if self._greeting is not None else ""

    @property
    def fps(self) -> float | None:
        """Frame rate from the server's greeting; None before the first `open()`."""
        return self._greeting.fps if self._greeting is not None else None

    async def open(self) -> None:
        """Connect and read the greeting."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        path = self._settings.path
        try:
            async with asyncio.timeout(GREETING_TIMEOUT_S):
                reader, self._writer = await asyncio.open_unix_connection(path, limit=2 * PIXEL_BYTES)
                line = await reader.readline()
            self._greeting = parse_greeting(line[:GREETING_MAX_BYTES])
        except (TimeoutError, OSError, ValueError, FrameStreamError) as error:
            await self.close()
            raise DeviceLost(f"{self._name}: {path}: {_reason(error)}") from None
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0)
        self._reading = asyncio.create_task(self._read(reader, self._stream), name=f"{self._name}: frames")

    async def next_frame(self) -> Frame:
        """Return the newest frame that was not returned before."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        return await self._stream.next()

    async def close(self) -> None:
        """Disconnect."""
        reading, self._reading = self._reading, None
        await cancel_and_wait(reading)
        if self._writer is not None:
            self._writer.close()
            with contextlib.suppress(OSError):
                await self._writer.wait_closed()
            self._writer = None
        self._stream = None

    async def _read(self, reader: asyncio.StreamReader, stream: FrameStream) -> None:
        try:
            while True:
                header = parse_header(await reader.readexactly(HEADER.size))
                pixels = await reader.readexactly(header.pixel_bytes)
                if header.damage is not None:
                    stream.damaged(header.damage)
                    continue
                image = np.frombuffer(pixels, np.uint8).reshape(FRAME_SHAPE)
                stream.put(image, header.captured_at_s, header.sequence)
        except (asyncio.IncompleteReadError, OSError):
            stream.lose("the frame server closed the connection")
        except FrameStreamError as error:
            stream.lose(f"the stream of frames is broken: {error}")


def parse_greeting(line: bytes) -> FrameGreeting:
    """Return the greeting. Raises FrameStreamError with the server's refusal, or with what came instead."""
    try:
        message = json.loads(line)
        if isinstance(message, dict) and "error" in message:
            raise FrameStreamError(str(message["error"]))
        greeting = FrameGreeting.model_validate(message)
    except (ValueError, ValidationError):
        raise FrameStreamError(f"{line[:40]!r} is not the greeting of a frame server") from None
    if greeting.frames != VERSION:
        raise FrameStreamError(f"frames of version {greeting.frames}; this driver reads version {VERSION}")
    return greeting


def parse_header(raw: bytes) -> FrameHeader:
    """Return the header of a frame. raw: 28 bytes. Raises FrameStreamError if they are not a header."""
    magic, width, height, size, captured_at_s, sequence = HEADER.unpack(raw)
    if magic != MAGIC:
        raise FrameStreamError(f"{magic!r} where a frame should begin with {MAGIC!r}")
    if size > PIXEL_BYTES_MAX:
        raise FrameStreamError(f"a frame of {size} bytes; the limit is {PIXEL_BYTES_MAX}")
    return FrameHeader(width, height, size, captured_at_s, sequence)


def _reason(error: Exception) -> str:
    if isinstance(error, TimeoutError):
        return f"no greeting within {GREETING_TIMEOUT_S:g} s; check that a frame server listens there"
    if isinstance(error, FileNotFoundError):
        return "no such socket; start the program that serves the frames, such as `slipguard emulate cell`"
    if isinstance(error, ConnectionRefusedError):
        return "no program serves frames there any more; start the frame server again"
    if isinstance(error, PermissionError):
        return "access is denied; use the account that serves the frames, or join its group"
    return getattr(error, "strerror", None) or str(error)
