"""A tactile sensor at the other end of a Unix socket: driver `socket`.

For cameras that another process owns: the emulated cell's, or a bridge to hardware that Python should not touch. The
format is that of `slipguard_emulators.cell.frames`.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path
from typing import Annotated, ClassVar

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceLost
from slipguard_drivers.digit.frame_stream import SHAPE, FrameStream
from slipguard_drivers.tasks import ended
from slipguard_emulators.cell.frames import (
    GREETING_MAX_BYTES,
    HEADER,
    PIXEL_BYTES,
    FrameGreeting,
    FrameStreamError,
    read_greeting,
    read_header,
)

GREETING_S = 2.0


class SocketSensor(TactileSensor):
    """One camera behind a frame server."""

    class Settings(BaseModel):
        """path: the server's Unix socket."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        only_one: ClassVar = ("path",)
        path: Path
        stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:
        self._name = context.name
        self._settings = settings
        self._greeting: FrameGreeting | None = None
        self._stream: FrameStream | None = None
        self._reading: asyncio.Task[None] | None = None
        self._writer: asyncio.StreamWriter | None = None

    @property
    def serial(self) -> str:
        """As the server told; empty before the first `open()`."""
        return self._greeting.serial if self._greeting is not None else ""

    @property
    def fps(self) -> float | None:
        """The rate the server says its camera was asked for; None before the first `open()`."""
        return self._greeting.fps if self._greeting is not None else None

    async def open(self) -> None:
        """Connect and be greeted."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        path = self._settings.path
        try:
            async with asyncio.timeout(GREETING_S):
                reader, self._writer = await asyncio.open_unix_connection(path, limit=2 * PIXEL_BYTES)
                line = await reader.readline()
            self._greeting = read_greeting(line[:GREETING_MAX_BYTES])
        except TimeoutError:
            await self.close()
            raise DeviceLost(f"{self._name}: {path} does not answer; is it a frame server?") from None
        except (OSError, ValueError) as error:
            await self.close()
            raise DeviceLost(f"{self._name}: {path}: {_reason(error)}") from None
        except FrameStreamError as error:
            await self.close()
            raise DeviceLost(f"{self._name}: {path}: {error}") from None
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0)
        self._reading = asyncio.create_task(self._read(reader, self._stream), name=f"{self._name}: frames")

    async def next_frame(self) -> Frame:
        """The newest frame not yet handed out."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        return await self._stream.next()

    async def close(self) -> None:
        """Disconnect."""
        reading, self._reading = self._reading, None
        await ended(reading)
        if self._writer is not None:
            self._writer.close()
            with contextlib.suppress(OSError):
                await self._writer.wait_closed()
            self._writer = None
        self._stream = None

    async def _read(self, reader: asyncio.StreamReader, stream: FrameStream) -> None:
        try:
            while True:
                header = read_header(await reader.readexactly(HEADER.size))
                pixels = await reader.readexactly(header.pixel_bytes)
                if header.damage is not None:
                    stream.damaged(header.damage)
                    continue
                image = np.frombuffer(pixels, np.uint8).reshape(SHAPE)
                stream.put(image, header.captured_at_s, header.sequence)
        except (asyncio.IncompleteReadError, OSError):
            stream.lose("the frame server has closed the connection")
        except FrameStreamError as error:
            stream.lose(f"the stream of frames is broken: {error}")


def _reason(error: Exception) -> str:
    if isinstance(error, FileNotFoundError):
        return "there is no such socket; start whatever serves the frames, such as `slipguard emulate cell`"
    if isinstance(error, ConnectionRefusedError):
        return "nobody serves frames there any more; start the frame server again"
    if isinstance(error, PermissionError):
        return "access is denied; become the user that serves the frames, or join its group"
    return getattr(error, "strerror", None) or str(error)
