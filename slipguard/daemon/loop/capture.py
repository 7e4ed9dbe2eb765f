"""Capture from one sensor: open it, keep its newest frame, open it again after a loss."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

from slipguard.cancellation import raise_if_cancelled
from slipguard.daemon.loop.async_tools import Backoff, LatestValue
from slipguard.daemon.loop.device_health import Health
from slipguard.daemon.loop.driver_failure import DRIVER_ERRORS, close_contained, error_place, failure_reason
from slipguard.daemon.loop.driver_values import checked_frame
from slipguard.daemon.loop.frame_causes import ARRIVALS, Arrival
from slipguard.devices import Frame, TactileSensor
from slipguard.errors import DeviceError, DeviceTimeout, FrameCorrupt, FrameFrozen, describe_error

COPIES_MAX = 4
"""Frames that wait in the queue of a copy."""
REOPEN_S = 2.0
"""A connected sensor that delivers only errors for this time is closed and opened again."""
TORN_MAX, TORN_WITHIN_S = 4, 1.0
"""More torn frames than this within this time restart the stream, after which a DIGIT tears less than 1 % of them."""
RESTART_INTERVAL_S = 10.0
"""Shortest time between two restarts of one stream: a restart costs about 0.3 s of its frames."""
RESTART_APART_S = 1.0
"""Shortest time between restarts of different streams: one finger always watches."""


@dataclass(slots=True)
class FrameCounts:
    """What happened to the frames of one sensor since the start."""

    frames: int = 0
    corrupt: int = 0
    torn: int = 0
    """Their two parts are from different captures."""
    restarts: int = 0
    """Restarts of the stream because of torn frames."""
    frozen: int = 0
    stalled: int = 0
    missed: int = 0
    """Counted by the camera, but never received."""
    late: int = 0
    """Replaced by a newer frame before the pipeline was free."""
    skipped: dict[str, int] = field(default_factory=dict)
    """By reason: frames for which the previous estimate was kept."""

    def add_error(self, error: DeviceError) -> None:
        """Count a frame that did not arrive or arrived damaged."""
        self.corrupt += isinstance(error, FrameCorrupt)
        self.frozen += isinstance(error, FrameFrozen)
        self.stalled += isinstance(error, DeviceTimeout)

    def add_skipped(self, reason: str) -> None:
        """Count a frame for which the previous estimate was kept."""
        self.skipped[reason] = self.skipped.get(reason, 0) + 1


class StreamRestarts:
    """Decides when repeated tearing restarts a stream; shared by the fingers, so that never both restart at once.

    Args:
        allowed: Returns whether this stream may be restarted now.
    """

    def __init__(self, allowed: Callable[[str], bool] = lambda name: True) -> None:
        self._allowed = allowed
        self._torn_at_s: dict[str, deque[float]] = {}
        self._restarted_at_s: dict[str, float] = {}

    def note_torn(self, name: str, now_s: float) -> None:
        """Note a torn frame of a stream."""
        self._torn_at_s.setdefault(name, deque(maxlen=TORN_MAX + 1)).append(now_s)

    def due(self, name: str, now_s: float) -> bool:
        """Return whether to restart a stream now; True counts as a restart."""
        torn_at_s = self._torn_at_s.get(name)
        if torn_at_s is None or len(torn_at_s) <= TORN_MAX or now_s - torn_at_s[0] > TORN_WITHIN_S:
            return False
        for other, restarted_at_s in self._restarted_at_s.items():
            if now_s - restarted_at_s < (RESTART_INTERVAL_S if other == name else RESTART_APART_S):
                return False
        if not self._allowed(name):
            return False
        self._torn_at_s[name].clear()
        self._restarted_at_s[name] = now_s
        return True


class SensorCapture:
    """Captures until cancelled; a missing sensor is retried, a stream that keeps tearing frames is restarted.

    Args:
        retry_s: First pause before a missing sensor is tried again.
        restarts: Shared by the fingers.
        on_open: Called with the sensor's serial number each time it has been opened, before its first frame.
        on_change: Called after each change of health.
    """

    def __init__(
        self,
        name: str,
        sensor: TactileSensor,
        retry_s: float,
        restarts: StreamRestarts,
        on_open: Callable[[str], None],
        on_change: Callable[[], None],
    ) -> None:
        self.name = name
        self.sensor = sensor
        self.health = Health(name)
        self.counts = FrameCounts()
        self.serial: str | None = None
        """Of the sensor opened last; None before that."""
        self.arrivals: deque[Arrival] = deque(maxlen=ARRIVALS)
        """The newest good frames since the sensor was opened."""
        self.newest_frame: Frame | None = None
        """The last good frame; None while the sensor is gone."""
        self.frames: LatestValue[tuple[Frame, float]] = LatestValue()
        """The newest frame not yet processed, and the loop time at which it was received."""
        self.frame_arrived = asyncio.Event()
        """Set for a moment by each good frame: wakes all that wait for the next one."""
        self.streaming = False
        self._copies: asyncio.Queue[Frame] | None = None
        self._backoff = Backoff(retry_s, longest_s=2 * retry_s)  # a cable pushed in again is noticed within a second
        self._restarts = restarts
        self._on_open, self._on_change = on_open, on_change

    def assume_serial(self, serial: str) -> None:
        """Use this serial number without opening the sensor."""
        self.serial = serial

    @property
    def remarks(self) -> list[str]:
        """Return the sensor's remarks; an exception of the driver is one."""
        try:
            return list(self.sensor.remarks)
        except Exception as error:
            return [f"error in {error_place(type(self.sensor), error)}: {describe_error(error)}"]

    @contextlib.contextmanager
    def copy_frames(self) -> Iterator[asyncio.Queue[Frame]]:
        """Copy every good frame into a short queue as well; a frame that does not fit is left out."""
        queue: asyncio.Queue[Frame] = asyncio.Queue(COPIES_MAX)
        self._copies = queue
        try:
            yield queue
        finally:
            self._copies = None

    async def run(self) -> None:
        """Capture until cancelled. After a loss, retry after a pause."""
        while True:
            try:
                await self._stream()
            except DRIVER_ERRORS as error:
                raise_if_cancelled()
                self.streaming = False
                self.newest_frame = None
                self.health.set_disconnected(failure_reason(self.sensor, error, self.health))
                self._on_change()
                await self.close()
                raise_if_cancelled()
                await self._backoff.wait()

    async def close(self) -> None:
        """Close the sensor."""
        await close_contained(self.sensor, self.health)

    def refuse_frame(self, reason: str, *, torn: bool = False) -> None:
        """Count a frame that was received but cannot be processed."""
        if torn:
            self._restarts.note_torn(self.name, asyncio.get_running_loop().time())
        self.counts.torn += torn
        self.counts.corrupt += not torn
        self._report_error(reason)

    async def _restart(self) -> None:
        """Stop and start the stream, which ends the tearing of a DIGIT."""
        self.counts.restarts += 1
        self._report_error(
            f"more than {TORN_MAX} torn frames within {TORN_WITHIN_S:g} s; the stream is restarted. If that is "
            "repeated, use ports of different USB controllers, or set fps = 30"
        )
        await self.close()
        raise_if_cancelled()
        await self.sensor.open()

    def _report_error(self, reason: str) -> None:
        self.health.set_error(reason)
        self._on_change()

    async def _stream(self) -> None:
        """Receive frames until the sensor is gone or has delivered no good frame for `REOPEN_S`."""
        await self.sensor.open()
        self.serial = self.sensor.serial
        self._on_open(self.serial)
        self.streaming = True
        self.arrivals.clear()
        loop = asyncio.get_running_loop()
        failing_since_s: float | None = None
        sequence: int | None = None
        while True:
            raise_if_cancelled()
            if self._restarts.due(self.name, loop.time()):
                await self._restart()
                failing_since_s = sequence = None
            try:
                frame = checked_frame(await self.sensor.next_frame())
            except (FrameCorrupt, FrameFrozen, DeviceTimeout) as error:
                self.counts.add_error(error)
                self._report_error(str(error))
                # Not since the last frame: this process may have been suspended meanwhile.
                failing_since_s = loop.time() if failing_since_s is None else failing_since_s
                if loop.time() - failing_since_s > REOPEN_S:
                    raise
                continue
            received_at_s = loop.time()
            failing_since_s = None
            self._backoff.reset()
            self.counts.frames += 1
            self.counts.missed += max(0, frame.sequence - sequence - 1) if sequence is not None else 0
            sequence = frame.sequence
            self.arrivals.append(Arrival(received_at_s, frame.captured_at_s, sequence))
            self.newest_frame = frame
            self.frame_arrived.set()
            self.frame_arrived.clear()
            if self._copies is not None and not self._copies.full():
                self._copies.put_nowait(frame)
            self.frames.put((frame, received_at_s))
            self.counts.late = self.frames.overwritten
