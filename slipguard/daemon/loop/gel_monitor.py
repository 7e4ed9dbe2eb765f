"""Monitor each gel while nothing touches it: drift of its light since the calibration, and wear.

One untouched frame every two seconds is sampled; thirty of them are averaged and compared once a minute, outside the
loop. The light is compared with the newest background image. Marks are compared with the first background image of
this gel, so that a new calibration does not hide wear. A change is logged once, after three equal comparisons in a row.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import partial

import cv2
import numpy as np
import structlog
from numpy.typing import NDArray

from slipguard.control.state import Phase
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.loop.gel_condition import GelCondition, GelStatus, assess_gel
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.background_images import BackgroundImage, BackgroundStore
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import SlipguardError
from slipguard.perception.background import GelChange, compare_gel

SAMPLE_S = 2.0
FRAMES = 30
CONFIRMED = 3
"""Comparisons in a row that must agree."""
RECOVERY_S = 5.0
"""The gel needs some seconds to recover after it was pressed."""
TOUCHED_S = 600.0
"""Contact for this long with open jaws at rest is no touch: something sticks to the gel, or the light has changed."""
log = structlog.get_logger()


@dataclass(slots=True)
class _SampleWindow:
    """One finger's samples since the last comparison."""

    total: NDArray[np.float32] = field(
        default_factory=lambda: np.zeros((FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3), np.float32)
    )
    frames: int = 0
    sampled_s: float = float("-inf")
    touched_s: float = float("-inf")
    """Capture time of the newest frame with contact."""
    touch_began_s: float | None = None
    touch_logged: bool = False
    agreeing: int = 0
    newest: GelStatus = GelStatus.OK
    logged: set[GelStatus] = field(default_factory=set)
    """Since the last calibration, so that light that comes and goes is logged once."""


class GelMonitor:
    """Monitors both gels of one service."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._windows = {name: _SampleWindow() for name in service.fingers}
        self._conditions: dict[str, GelCondition] = {}
        self._averages: asyncio.Queue[tuple[str, NDArray[np.float32]]] = asyncio.Queue()

    @property
    def conditions(self) -> Mapping[str, GelCondition]:
        """By finger, the newest comparison; a finger is missing until its first one."""
        return self._conditions

    async def run(self) -> None:
        """Monitor until cancelled."""
        with contextlib.ExitStack() as attached:
            for name, finger in self._service.fingers.items():
                attached.enter_context(finger.observers.attached(partial(self.add_frame, name)))
            while True:
                name, mean = await self._averages.get()
                await self._compare(name, mean)

    def add_frame(self, name: str, processed: ProcessedFrame) -> None:
        """Take one frame of a finger into account. Takes microseconds; every `SAMPLE_S` a tenth of a millisecond."""
        window, now_s = self._windows[name], processed.frame.captured_at_s
        if processed.new_pipeline:
            self._windows[name] = window = _SampleWindow()
            self._conditions.pop(name, None)
        if processed.estimate is None or processed.estimate.unusable:
            return
        if processed.estimate.contact:
            window.touched_s = now_s
            self._check_lasting_contact(name, window, now_s)
            return
        window.touch_began_s = None
        at_rest = self._service.phase is Phase.IDLE and now_s - window.touched_s >= RECOVERY_S
        if at_rest and now_s - window.sampled_s >= SAMPLE_S:
            window.sampled_s = now_s
            cv2.accumulate(np.ascontiguousarray(processed.frame.image), window.total)
            window.frames += 1
            if window.frames == FRAMES:
                self._averages.put_nowait((name, window.total / np.float32(FRAMES)))
                window.total, window.frames = np.zeros_like(window.total), 0

    def _check_lasting_contact(self, name: str, window: _SampleWindow, now_s: float) -> None:
        """Log contact that does not end although the jaws are open; no comparison is possible then."""
        gripper = self._service.gripper.newest
        open_and_at_rest = gripper is not None and not (gripper.holding or gripper.moving or gripper.closed_on_nothing)
        if self._service.phase is not Phase.IDLE or not open_and_at_rest:
            window.touch_began_s = None
            return
        window.touch_began_s = now_s if window.touch_began_s is None else window.touch_began_s
        if now_s - window.touch_began_s >= TOUCHED_S and not window.touch_logged:
            window.touch_logged = True
            self._service.event_log.warning(
                f"{name}: contact for {TOUCHED_S / 60:.0f} minutes with open jaws; check whether something sticks to "
                "the gel; if not, its light has changed: run `slipguard calibrate --force`"
            )

    async def _compare(self, name: str, mean: NDArray[np.float32]) -> None:
        finger, config, window = self._service.fingers[name], self._service.config, self._windows[name]
        serial = finger.serial
        if serial is None:
            return
        try:
            compared = await asyncio.to_thread(_compare_with_stored, self._service.store, serial, mean)
        except SlipguardError:  # a damaged or missing image is reported elsewhere
            return
        except Exception:  # the guard must go on
            log.exception("gel comparison failed", finger=name)
            return
        if compared is None or window is not self._windows[name]:  # calibrated in the meantime
            return
        self._conditions[name] = gel = assess_gel(*compared, getattr(config, name).px_per_mm)
        window.agreeing = window.agreeing + 1 if gel.status is window.newest else 1
        window.newest = gel.status
        worse = gel.status in (GelStatus.DRIFTED, GelStatus.WORN)
        if worse and window.agreeing >= CONFIRMED and gel.status not in window.logged:
            window.logged.add(gel.status)
            self._service.event_log.warning(f"{name} ({serial}): {gel.observed}; {gel.action}")


def _compare_with_stored(
    store: BackgroundStore, serial: str, mean: NDArray[np.float32]
) -> tuple[GelChange, GelChange] | None:
    """Return the change since the newest background image and since the first one of the gel; None if there is none."""
    newest, first = store.load_background(serial), store.first_of_gel(serial)
    if newest is None or first is None:
        return None

    def since(known: BackgroundImage) -> GelChange:
        return compare_gel(mean, FRAMES, known.image, known.noise_bgr, known.frames)

    light = since(newest)
    return light, light if np.array_equal(first.image, newest.image) else since(first)
