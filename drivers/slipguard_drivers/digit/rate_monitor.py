"""Compares the rate of the received frames with the requested rate."""

from __future__ import annotations

WINDOW_S = 2.0
DELIVERED_SHARE_MIN = 0.9
RECEIVED_SHARE_MIN = 0.9


class FrameRateMonitor:
    """Receives capture time and number of each frame; `remark` is about the last complete window.

    The camera driver counts every frame, also those that no program read. So frames that the camera did not deliver
    can be distinguished from frames that this machine was too busy to read.
    """

    def __init__(self, requested_fps: float) -> None:
        self.remark: str | None = None
        self._requested_fps = requested_fps
        self._window_start: tuple[float, int] | None = None
        self._in_window = 0

    def note(self, captured_at_s: float, sequence: int) -> None:
        """Count a received frame, damaged or not."""
        start = self._window_start
        if start is None or sequence < start[1] or captured_at_s < start[0]:
            self._window_start, self._in_window = (captured_at_s, sequence), 0
            return
        self._in_window += 1
        elapsed_s = captured_at_s - start[0]
        if elapsed_s < WINDOW_S:
            return
        delivered_fps, received_fps = (sequence - start[1]) / elapsed_s, self._in_window / elapsed_s
        self._window_start, self._in_window = (captured_at_s, sequence), 0
        self.remark = self._rate_remark(delivered_fps, received_fps)

    def _rate_remark(self, delivered_fps: float, received_fps: float) -> str | None:
        if delivered_fps < DELIVERED_SHARE_MIN * self._requested_fps:
            return (
                f"the camera delivers only {delivered_fps:.0f} of {self._requested_fps:g} frames per second; use a USB "
                'port without a hub for each sensor, or set fps = 30 or pixels = "MJPG"'
            )
        if received_fps < RECEIVED_SHARE_MIN * delivered_fps:
            return (
                f"only {received_fps:.0f} of {delivered_fps:.0f} frames per second are read: this machine is too busy; "
                "end other programs"
            )
        return None
