"""Driver `digit`: a DIGIT over V4L2, found by its serial number, with the kernel's capture times."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable

from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.diagnosis import CheckResult
from slipguard.errors import DeviceLost
from slipguard.frame_stream import FrameStream
from slipguard_drivers.digit.capture import RawFrame, V4l2Capture, VideoMode
from slipguard_drivers.digit.decoding import DamagedFrame, JpegDecoder, decode_yuyv
from slipguard_drivers.digit.diagnostics import check_digit
from slipguard_drivers.digit.discovery import DigitDevice, find_digit
from slipguard_drivers.digit.rate_monitor import FrameRateMonitor
from slipguard_drivers.digit.stream_setup import DigitSettings, StartedStream, reason, start_digit

EMPTY_WAKE_UPS_MAX = 100
"""After this many wake-ups in a row without a frame, a device in error is lost; else the loop would spin forever."""


class DigitSensor(TactileSensor):
    """One DIGIT on USB. Opening and closing, which wait for USB, run in a thread."""

    Settings = DigitSettings

    def __init__(
        self,
        settings: DigitSettings,
        context: DriverContext,
        find: Callable[[str, str], DigitDevice] = find_digit,
        capture: Callable[[str], V4l2Capture] = V4l2Capture,
    ) -> None:
        """find, capture: replaced by tests, which have no such kernel device."""
        self._name = context.name
        self._settings = settings
        self._find = find
        self._open_capture = capture
        self._capture: V4l2Capture | None = None
        self._stream: FrameStream | None = None
        self._decoder: JpegDecoder | None = None
        self.rate: FrameRateMonitor | None = None
        """Number of frames received and lost since `open`."""
        self._opening_remarks: tuple[str, ...] = ()
        self._empty_wake_ups = 0
        self.device: DigitDevice | None = None
        """The device that was opened last."""
        self.mode: VideoMode | None = None
        """Its video mode."""

    @property
    def serial(self) -> str:
        """The configured serial number; `open` finds the sensor by it."""
        return self._settings.serial

    @property
    def remarks(self) -> tuple[str, ...]:
        """What works, but not as configured: another rate, LEDs that cannot be set, missing frames."""
        rate_remark = self.rate.remark if self.rate is not None else None
        return (*self._opening_remarks, rate_remark) if rate_remark else self._opening_remarks

    async def open(self) -> None:
        """Find the sensor, set format, rate and LEDs, start the stream."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        loop = asyncio.get_running_loop()
        starting = loop.run_in_executor(None, start_digit, self._settings, self._name, self._find, self._open_capture)
        try:
            device, capture, mode, remarks = await asyncio.shield(starting)
        except asyncio.CancelledError:
            starting.add_done_callback(_close_started)
            raise
        self.device, self.mode, self._opening_remarks = device, mode, remarks
        self._capture = capture
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0)
        self._decoder = JpegDecoder(self._stream) if mode.pixels == "MJPG" else None
        self.rate = FrameRateMonitor(mode.fps or self._settings.fps)
        self._empty_wake_ups = 0
        loop.add_reader(capture.fileno(), self._on_readable)

    async def next_frame(self) -> Frame:
        """Return the newest frame that was not returned before."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        return await self._stream.next()

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """Check the device for `slipguard doctor`, without opening it."""
        for result in check_digit(self._name, self._settings):
            yield result

    async def close(self) -> None:
        """Stop the stream and close the device."""
        capture, self._capture = self._capture, None
        self._stream = self._decoder = self.rate = None
        self._opening_remarks = ()
        if capture is not None:
            loop = asyncio.get_running_loop()
            loop.remove_reader(capture.fileno())
            await asyncio.shield(loop.run_in_executor(None, capture.close))

    def _lose(self, why: str) -> None:
        """Stop reading; `close` or the next `open` closes the device."""
        assert self._capture is not None
        assert self._stream is not None
        asyncio.get_running_loop().remove_reader(self._capture.fileno())
        self._stream.lose(why)

    def _on_readable(self) -> None:
        """Read all waiting frames and keep the newest."""
        assert self._capture is not None
        assert self.rate is not None
        newest: RawFrame | None = None
        try:
            while (frame := self._capture.take()) is not None:
                newest = frame
                self.rate.note(self._capture_time_s(frame), frame.sequence)
        except OSError as error:
            self._lose(f"the sensor is gone: {reason(error)}")
            return
        if newest is not None:
            self._empty_wake_ups = 0
            self._deliver(newest)
            return
        self._empty_wake_ups += 1
        if self._empty_wake_ups >= EMPTY_WAKE_UPS_MAX:
            self._lose("the camera driver reports an error and delivers no frames; plug the sensor in again")

    def _deliver(self, frame: RawFrame) -> None:
        assert self._stream is not None
        if frame.damage is not None:
            self._stream.damaged(frame.damage)
        elif self._decoder is not None:
            self._decoder.offer(frame, self._capture_time_s(frame))
        else:
            try:
                self._stream.put(decode_yuyv(frame.data), self._capture_time_s(frame), frame.sequence)
            except DamagedFrame as damage:
                self._stream.damaged(str(damage))

    def _capture_time_s(self, frame: RawFrame) -> float:
        """Return the capture time; the time of arrival if the camera driver uses another clock."""
        if frame.captured_at_s is None:
            return asyncio.get_running_loop().time()
        return frame.captured_at_s


def _close_started(starting: asyncio.Future[StartedStream]) -> None:
    """Close a sensor whose caller was cancelled during the start."""
    if not starting.cancelled() and starting.exception() is None:
        starting.result()[1].close()
