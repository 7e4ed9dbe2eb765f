"""A DIGIT over V4L2: found by its serial number, frames with the kernel's time, the newest one wins."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.diagnosis import CheckResult
from slipguard.errors import DeviceLost
from slipguard.frame_stream import FrameStream
from slipguard_drivers.digit.capture import RawFrame, V4l2Capture, VideoMode
from slipguard_drivers.digit.decoder import JpegDecoder
from slipguard_drivers.digit.diagnostics import check_digit
from slipguard_drivers.digit.discovery import DigitDevice, find_digit
from slipguard_drivers.digit.pixel_format import DamagedFrame, decode_yuyv
from slipguard_drivers.digit.rate_monitor import FrameRateMonitor
from slipguard_drivers.digit.settings import DigitSettings
from slipguard_drivers.digit.stream_setup import Started, reason, start_digit

EMPTY_WAKE_UPS = 100
"""Wake-ups in a row without a frame after which a device in error is given up; else it would spin for ever."""


class DigitSensor(TactileSensor):
    """One DIGIT on USB. Opening and closing, which take as long as USB answers, run beside the event loop."""

    Settings = DigitSettings

    def __init__(
        self,
        settings: DigitSettings,
        context: DriverContext,
        find: Callable[[str, str], DigitDevice] = find_digit,
        capture: Callable[[str], V4l2Capture] = V4l2Capture,
    ) -> None:
        """find, capture: how a serial becomes a device and a device an open one; for cameras without a kernel."""
        self._name = context.name
        self._settings = settings
        self._find = find
        self._open_capture = capture
        self._capture: V4l2Capture | None = None
        self._stream: FrameStream | None = None
        self._decoder: JpegDecoder | None = None
        self.rate: FrameRateMonitor | None = None
        """How many frames came and how many were lost since it was opened."""
        self._opening_remarks: tuple[str, ...] = ()
        self._empty_wake_ups = 0
        self.found: DigitDevice | None = None
        """The device that was opened last."""
        self.mode: VideoMode | None = None
        """How it delivers."""

    @property
    def serial(self) -> str:
        """As configured; `open` finds the sensor by it."""
        return self._settings.serial

    @property
    def remarks(self) -> tuple[str, ...]:
        """What is not as asked, in words: another rate, LEDs that cannot be set, frames that stay away."""
        late = self.rate.remark if self.rate is not None else None
        return (*self._opening_remarks, late) if late else self._opening_remarks

    async def open(self) -> None:
        """Find the sensor, set format, rate and LEDs, start the stream."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        loop = asyncio.get_running_loop()
        starting = loop.run_in_executor(None, start_digit, self._settings, self._name, self._find, self._open_capture)
        try:
            found, capture, mode, remarks = await asyncio.shield(starting)
        except asyncio.CancelledError:
            starting.add_done_callback(_close_unwanted)
            raise
        self.found, self.mode, self._opening_remarks = found, mode, remarks
        self._capture = capture
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0)
        self._decoder = JpegDecoder(self._stream) if mode.pixels == "MJPG" else None
        self.rate = FrameRateMonitor(mode.fps or self._settings.fps)
        self._empty_wake_ups = 0
        loop.add_reader(capture.fileno(), self._on_readable)

    async def next_frame(self) -> Frame:
        """The newest frame not yet handed out."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        return await self._stream.next()

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """For the doctor: what there is to see from outside."""
        for result in check_digit(self._name, self._settings):
            yield result

    async def close(self) -> None:
        """Stop the stream and let go of the device."""
        capture, self._capture = self._capture, None
        self._stream = self._decoder = self.rate = None
        self._opening_remarks = ()
        if capture is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(capture.fileno())
            await asyncio.shield(loop.run_in_executor(None, capture.close))

    def _lose(self, why: str) -> None:
        """Stop listening; the device itself is let go by `close` or the next `open`."""
        assert self._capture is not None
        assert self._stream is not None
        asyncio.get_running_loop().remove_reader(self._capture.fileno())
        self._stream.lose(why)

    def _on_readable(self) -> None:
        """Drain what waits in the driver and keep the newest."""
        assert self._capture is not None
        assert self.rate is not None
        newest: RawFrame | None = None
        try:
            while (delivery := self._capture.take()) is not None:
                newest = delivery
                self.rate.note(self._time_of(delivery), delivery.sequence)
        except OSError as error:
            self._lose(f"the sensor is gone: {reason(error)}")
            return
        if newest is not None:
            self._empty_wake_ups = 0
            self._deliver(newest)
            return
        self._empty_wake_ups += 1
        if self._empty_wake_ups >= EMPTY_WAKE_UPS:
            self._lose("the camera driver signals an error and delivers nothing")

    def _deliver(self, delivery: RawFrame) -> None:
        assert self._stream is not None
        if delivery.damage is not None:
            self._stream.damaged(delivery.damage)
        elif self._decoder is not None:
            self._decoder.offer(delivery, self._time_of(delivery))
        else:
            try:
                self._stream.put(decode_yuyv(delivery.data), self._time_of(delivery), delivery.sequence)
            except DamagedFrame as damage:
                self._stream.damaged(str(damage))

    def _time_of(self, delivery: RawFrame) -> float:
        """When it was captured; that it came now is all there is to say where the driver's clock is another."""
        if delivery.captured_at_s is None:
            return asyncio.get_running_loop().time()
        return delivery.captured_at_s


def _close_unwanted(starting: asyncio.Future[Started]) -> None:
    """The caller has gone while the sensor was being started."""
    if not starting.cancelled() and starting.exception() is None:
        starting.result()[1].close()
