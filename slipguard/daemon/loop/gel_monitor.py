"""Watches each gel while nothing touches it: how its light has drifted since it was calibrated, and what has worn.

An observer takes one untouched frame in two seconds; thirty of them are averaged and compared beside the loop, once a
minute. The light is compared with the newest no-contact image, marks with the first one of this gel, so that wear does
not hide behind the next calibration. Only what three minutes in a row agree on is said, and said once.
"""

from __future__ import annotations

import asyncio
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
import structlog
from numpy.typing import NDArray

from slipguard.control.state import Phase
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.gel_condition import GelStatus, describe_gel
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.calibration import BackgroundArchive, BackgroundImage, Store
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import SlipguardError
from slipguard.perception.quality.gel_wear import GelChange, compare_gel

SAMPLE_S = 2.0
FRAMES = 30
CONFIRMED = 3
"""Comparisons in a row that must agree."""
RECOVERY_S = 5.0
"""The gel takes some seconds to come back after it was pressed."""
TOUCHED_S = 600.0
"""Contact for so long with the jaws open and at rest is no touch: something sticks, or the light has gone far."""
log = structlog.get_logger()


@dataclass(slots=True)
class _Window:
    """What one finger has shown since the last comparison."""

    total: NDArray[np.float32] = field(
        default_factory=lambda: np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), np.float32)
    )
    frames: int = 0
    sampled_s: float = float("-inf")
    touched_s: float = float("-inf")
    """When the newest frame with contact was taken."""
    touch_began_s: float | None = None
    touch_told: bool = False
    agreeing: int = 0
    newest: GelStatus = GelStatus.OK
    told: set[GelStatus] = field(default_factory=set)
    """Since the last calibration: light that comes and goes is said once."""


class GelMonitor:
    """One service's; what it finds is the fingers' `gel`."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._windows = {name: _Window() for name in service.fingers}
        self._full: asyncio.Queue[tuple[str, NDArray[np.float32]]] = asyncio.Queue()

    async def run(self) -> None:
        """Watch until cancelled."""
        service = self._service
        watching = [(finger, partial(self.judged, name)) for name, finger in service.fingers.items()]
        for finger, observer in watching:
            finger.observers.append(observer)
        try:
            while True:
                name, mean = await self._full.get()
                await self._compare(name, mean)
        finally:
            for finger, observer in watching:
                finger.observers.remove(observer)

    def judged(self, name: str, processed: ProcessedFrame) -> None:
        """One frame: some microseconds, and a tenth of a millisecond for one in `SAMPLE_S`."""
        window, now_s = self._windows[name], processed.frame.captured_at_s
        if processed.new_pipeline:
            self._windows[name] = window = _Window()
            self._service.fingers[name].gel = None
        if processed.estimate is None:
            return
        if processed.estimate.contact:
            window.touched_s = now_s
            self._touched(name, window, now_s)
            return
        window.touch_began_s = None
        rests = self._service.phase is Phase.IDLE and now_s - window.touched_s >= RECOVERY_S
        if rests and now_s - window.sampled_s >= SAMPLE_S:
            window.sampled_s = now_s
            cv2.accumulate(np.ascontiguousarray(processed.frame.image), window.total)
            window.frames += 1
            if window.frames == FRAMES:
                self._full.put_nowait((name, window.total / np.float32(FRAMES)))
                window.total, window.frames = np.zeros_like(window.total), 0

    def _touched(self, name: str, window: _Window, now_s: float) -> None:
        """Contact that never ends, with the jaws open: no comparison can be made then."""
        gripper = self._service.gripper.newest
        open_and_at_rest = gripper is not None and not (gripper.holding or gripper.moving or gripper.closed_on_nothing)
        if self._service.phase is not Phase.IDLE or not open_and_at_rest:
            window.touch_began_s = None
            return
        window.touch_began_s = now_s if window.touch_began_s is None else window.touch_began_s
        if now_s - window.touch_began_s >= TOUCHED_S and not window.touch_told:
            window.touch_told = True
            self._service.event_log.warning(
                f"{name}: contact for {TOUCHED_S / 60:.0f} minutes with the jaws open; look whether something sticks "
                "to the gel; if not, its light has changed: `slipguard calibrate --force`"
            )

    async def _compare(self, name: str, mean: NDArray[np.float32]) -> None:
        finger, store = self._service.fingers[name], self._service.store
        serial, window = finger.serial, self._windows[name]
        if serial is None:
            return
        settings = self._service.config
        px_per_mm, gate_sigma = getattr(settings, name).px_per_mm, settings.perception.gate_sigma
        try:
            compared = await asyncio.to_thread(_compared, store, serial, mean, gate_sigma)
        except SlipguardError:  # a damaged or missing image is said elsewhere
            return
        except Exception:  # the guard must not end with it
            log.exception("gel not compared", finger=name)
            return
        if compared is None or window is not self._windows[name]:  # calibrated meanwhile
            return
        gel = describe_gel(*compared, px_per_mm)
        finger.gel = gel
        window.agreeing = window.agreeing + 1 if gel.status is window.newest else 1
        window.newest = gel.status
        worse = gel.status in (GelStatus.DRIFTED, GelStatus.WORN)
        if worse and window.agreeing >= CONFIRMED and gel.status not in window.told:
            window.told.add(gel.status)
            self._service.event_log.warning(f"{name} ({serial}): {gel.observed}; {gel.action}")


def _compared(
    store: Store, serial: str, mean: NDArray[np.float32], gate_sigma: float
) -> tuple[GelChange, GelChange] | None:
    newest = store.load_background(serial)
    first = store.first_of_gel(serial) if isinstance(store, BackgroundArchive) else newest
    if newest is None or first is None:
        return None

    def since(known: BackgroundImage) -> GelChange:
        return compare_gel(mean, FRAMES, known.image, known.noise_bgr, known.frames, gate_sigma)

    light = since(newest)
    return light, light if np.array_equal(first.image, newest.image) else since(first)
