"""Driver `opencv_camera`: a tactile sensor with any camera that OpenCV opens."""

import asyncio
import time
from threading import Thread

import cv2
from pydantic import BaseModel, ConfigDict

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceLost
from slipguard.frame_stream import FrameStream


class OpenCvSensor(TactileSensor):
    class Settings(BaseModel):  # the table [left.opencv_camera] of config.toml
        model_config = ConfigDict(frozen=True, extra="forbid")
        serial: str  # the background image is stored under this name
        source: int | str = 0  # 0 is /dev/video0; or a URL, such as an IP camera's

    def __init__(self, settings: Settings, context: DriverContext) -> None:  # opens nothing
        self._name, self._settings = context.name, settings
        self._stream: FrameStream | None = None

    @property
    def serial(self) -> str:
        return self._settings.serial

    async def open(self) -> None:
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        camera = await asyncio.to_thread(cv2.VideoCapture, self._settings.source)  # may block: not in the event loop
        if not camera.isOpened():
            raise DeviceLost(f"{self._name}: camera {self._settings.source} cannot be opened. Check its cable.")
        self._stream = FrameStream(self._name, stall_s=0.25)  # newest frame wins; detects stalled and frozen cameras
        self._thread = Thread(target=self._read, args=(camera, self._stream, asyncio.get_running_loop()))
        self._thread.start()

    async def next_frame(self) -> Frame:
        if self._stream is None:
            raise DeviceLost(f"{self._name}: not open; call open() first")
        return await self._stream.next()

    async def close(self) -> None:
        if self._stream is not None:
            self._stream = None  # ends the thread
            await asyncio.to_thread(self._thread.join)

    def _read(self, camera: cv2.VideoCapture, stream: FrameStream, loop: asyncio.AbstractEventLoop) -> None:
        sequence = 0
        while self._stream is stream and (result := camera.read())[0]:
            sequence += 1
            image = result[1]  # BGR
            if image.shape[0] < image.shape[1]:  # landscape, as most cameras deliver
                image = cv2.rotate(image, cv2.ROTATE_90_COUNTERCLOCKWISE)
            image = cv2.resize(image, (240, 320), interpolation=cv2.INTER_AREA)
            loop.call_soon_threadsafe(stream.put, image, time.monotonic(), sequence)
        loop.call_soon_threadsafe(stream.lose, "the camera delivers no more frames. Check its cable.")
        camera.release()
