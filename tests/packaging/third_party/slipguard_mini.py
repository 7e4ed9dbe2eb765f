import asyncio
import time
from threading import Thread

import cv2
from pydantic import BaseModel, ConfigDict

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceLost
from slipguard.frame_stream import FrameStream


class MiniSensor(TactileSensor):
    class Settings(BaseModel):  # the table [left.mini]
        model_config = ConfigDict(frozen=True, extra="forbid")
        serial: str
        source: int = 0

    def __init__(self, settings: Settings, context: DriverContext) -> None:  # touches no hardware
        self._name, self._settings = context.name, settings
        self._stream: FrameStream | None = None

    @property
    def serial(self) -> str:
        return self._settings.serial

    async def open(self) -> None:
        if self._stream is None or self._stream.lost:
            await self.close()
            camera = await asyncio.to_thread(cv2.VideoCapture, self._settings.source)
            if not camera.isOpened():
                raise DeviceLost(f"{self._name}: no camera {self._settings.source}; check its cable")
            self._stream = FrameStream(self._name, stall_s=0.25)  # newest wins; tells a stalled or frozen camera
            self._thread = Thread(target=self._read, args=(camera, self._stream, asyncio.get_running_loop()))
            self._thread.start()

    async def next_frame(self) -> Frame:
        if self._stream is None:
            raise DeviceLost(f"{self._name}: not open; open it first")
        return await self._stream.next()

    async def close(self) -> None:
        if self._stream is not None:
            self._stream = None  # tells the thread to end
            await asyncio.to_thread(self._thread.join)

    def _read(self, camera: cv2.VideoCapture, stream: FrameStream, loop: asyncio.AbstractEventLoop) -> None:
        sequence = 0
        while self._stream is stream and (read := camera.read())[0]:
            sequence += 1
            picture = cv2.resize(read[1], (240, 320))  # upright, B, G, R
            loop.call_soon_threadsafe(stream.put, picture, time.monotonic(), sequence)
        loop.call_soon_threadsafe(stream.lose, "the camera delivers nothing any more; check its cable")
        camera.release()
