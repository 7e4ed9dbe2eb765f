"""Watches whether as many frames come as were asked for, and says in words where they stay."""

from __future__ import annotations

WINDOW_S = 2.0
LEAST_MADE = 0.9
LEAST_TAKEN = 0.9


class FrameRateMonitor:
    """Fed with the time stamp and number of every frame taken; `remark` is about the last whole window.

    The camera driver counts every picture it makes, also those that nobody took: so what the camera did not make can be
    told from what this machine was too busy to take.
    """

    def __init__(self, asked_fps: float) -> None:
        self.remark: str | None = None
        self.fps: float | None = None
        """Frames a second taken in the last whole window; None before the first."""
        self.taken = 0
        """All frames."""
        self.lost = 0
        """Those that the camera driver counted and nobody took."""
        self._asked_fps = asked_fps
        self._sequence: int | None = None
        self._begin: tuple[float, int] | None = None
        self._in_window = 0

    def note(self, captured_at_s: float, sequence: int) -> None:
        """Another frame has been taken, damaged or not."""
        self.taken += 1
        if self._sequence is not None:
            self.lost += max(0, sequence - self._sequence - 1)
        self._sequence = sequence
        if self._begin is None or sequence < self._begin[1] or captured_at_s < self._begin[0]:
            self._begin, self._in_window = (captured_at_s, sequence), 0
            return
        self._in_window += 1
        elapsed_s = captured_at_s - self._begin[0]
        if elapsed_s < WINDOW_S:
            return
        made, taken = (sequence - self._begin[1]) / elapsed_s, self._in_window / elapsed_s
        self._begin, self._in_window = (captured_at_s, sequence), 0
        self.fps = taken
        self.remark = self._judge(made, taken)

    def _judge(self, made: float, taken: float) -> str | None:
        if made < LEAST_MADE * self._asked_fps:
            return (
                f"only {made:.0f} of {self._asked_fps:g} frames a second come from the camera: plug each sensor into "
                'a USB port of its own, without a hub, or set fps = 30 or pixels = "MJPG"'
            )
        if taken < LEAST_TAKEN * made:
            return f"only {taken:.0f} of {made:.0f} frames a second are taken: this machine is too busy"
        return None
