"""Driver `replay`: plays a folder of recorded frames at a camera's rate."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Annotated

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import ConfigError, DeviceLost
from slipguard.frame_stream import FrameStream


class ReplaySettings(BaseModel):
    """path: a folder of PNG files. serial: of the sensor that recorded them; its background image is used."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    path: Path
    fps: Annotated[float, Field(gt=0.0, le=240.0)] = 60.0
    loop: bool = True
    serial: str = "REPLAY"
    stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0


class ReplaySensor(TactileSensor):
    """Plays the PNG files of a folder, sorted by name. At the end it repeats them, or is lost until opened again."""

    Settings = ReplaySettings

    def __init__(self, settings: ReplaySettings, context: DriverContext) -> None:
        self._name = context.name
        self._settings = settings
        self._files = sorted(settings.path.glob("*.png"))
        if not self._files:
            raise ConfigError(f"{context.name}: {settings.path} has no .png files; path must name a folder of frames")
        self._stream: FrameStream | None = None
        self._timer: asyncio.TimerHandle | None = None
        self._started_at_s = 0.0

    @property
    def serial(self) -> str:
        """The configured serial number."""
        return self._settings.serial

    async def open(self) -> None:
        """Start playing from the first file."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0 + 1.0 / self._settings.fps)
        self._started_at_s = asyncio.get_running_loop().time()
        self._schedule(1)

    async def next_frame(self) -> Frame:
        """Return the newest frame that was not returned before."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        return await self._stream.next()

    async def close(self) -> None:
        """Stop playing."""
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._stream = None

    def _schedule(self, sequence: int) -> None:
        due_s = self._started_at_s + sequence / self._settings.fps
        self._timer = asyncio.get_running_loop().call_at(due_s, self._play, sequence)

    def _play(self, sequence: int) -> None:
        """Deliver one file; if the loop is late, the missed ones follow at once and the newest wins."""
        assert self._stream is not None
        index = sequence - 1
        if index >= len(self._files) and not self._settings.loop:
            self._stream.lose(f"the recording in {self._settings.path} has ended; open the sensor to play it again")
            return
        self._schedule(sequence + 1)
        file = self._files[index % len(self._files)]
        image = cv2.imread(str(file), cv2.IMREAD_COLOR)
        if image is None:
            self._stream.damaged(f"{file} is not an image")
            return
        self._stream.put(np.asarray(image, dtype=np.uint8), asyncio.get_running_loop().time(), sequence)
