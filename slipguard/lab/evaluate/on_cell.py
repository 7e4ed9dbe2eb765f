"""The experiment on a real cell: a person places the objects, slipguard grips, lifts, records, lowers, lets go."""

from __future__ import annotations

import asyncio
import threading
from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import Self

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.controls import Controls
from slipguard.daemon.service import Service
from slipguard.errors import DeviceLost, InputError, SlipguardError
from slipguard.grasp.state import Phase
from slipguard.lab.evaluate.intrinsics import Intrinsics
from slipguard.lab.evaluate.lift_file import LiftFile, encoded
from slipguard.lab.evaluate.protocol import Lift, Protocol
from slipguard.lab.evaluate.runner import prepare, recording_path, result_of

READY_S = 20.0
PHASE_S = 30.0
STILL_S = 1.0
Ask = Callable[[str], bool]


class Camera:
    """Any camera OpenCV opens, read in a thread of its own; the newest picture wins. Raises InputError."""

    def __init__(self, source: str, intrinsics: Intrinsics) -> None:
        self._capture = cv2.VideoCapture(int(source)) if source.isdigit() else cv2.VideoCapture(source)
        self._capture.set(cv2.CAP_PROP_FRAME_WIDTH, intrinsics.width_px)
        self._capture.set(cv2.CAP_PROP_FRAME_HEIGHT, intrinsics.height_px)
        good, picture = self._capture.read()
        if not good:
            self._capture.release()
            raise InputError(f"--camera {source}: gives no picture; `v4l2-ctl --list-devices` names what there is")
        intrinsics.check_size(picture.shape[1], picture.shape[0], f"--camera {source}")
        self._taker: Callable[[NDArray[np.uint8]], None] | None = None
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._read, name="external camera", daemon=True)
        self.lost = False

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ending.set()
        self._thread.join(2.0)
        self._capture.release()

    def give_to(self, taker: Callable[[NDArray[np.uint8]], None] | None) -> None:
        """Call `taker` in the camera's thread with every picture from now on."""
        self._taker = taker

    def _read(self) -> None:
        while not self._ending.is_set():
            good, picture = self._capture.read()
            taker = self._taker
            if not good:
                self.lost = True
                return
            if taker is not None:
                taker(np.asarray(picture, np.uint8))


async def run_on_cell(
    out: Path, protocol: Protocol, service: Service, camera: Camera | None, intrinsics: Intrinsics, ask: Ask
) -> None:
    """Do what is still missing with a service that is not yet running.

    camera: None where somebody films the lifts and puts the films beside the recordings.

    ask: shows a line and returns whether to go on. Raises SlipguardError where a lift fails; what was done is kept.
    """
    todo = prepare(out, protocol)
    running = asyncio.create_task(service.run())
    try:
        await _until(running, lambda: not service.waiting_for, READY_S, lambda: "; ".join(service.waiting_for))
        controls = Controls(service)
        if not protocol.guard:
            await controls.guard(False)
        for lift in todo:
            line = f"{lift.stem}: place {lift.thing.name} so that the lift turns it by about {lift.target_deg:.0f}°"
            if not await asyncio.to_thread(ask, line):
                return
            await _lift(out, protocol, lift, service, controls, camera, intrinsics, running, ask)
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)


async def _lift(
    out: Path,
    protocol: Protocol,
    lift: Lift,
    service: Service,
    controls: Controls,
    camera: Camera | None,
    intrinsics: Intrinsics,
    running: asyncio.Task[None],
    ask: Ask,
) -> None:
    loop = asyncio.get_running_loop()
    path = recording_path(out, lift)
    with LiftFile(path, service, protocol, lift, intrinsics, None) as file:

        def take(picture: NDArray[np.uint8]) -> None:
            at_s = loop.time()
            jpeg = encoded(picture)
            loop.call_soon_threadsafe(file.camera, at_s, jpeg)

        if camera is not None:
            camera.give_to(take)
        try:
            await controls.grasp(lift.thing.grip_force_n or protocol.grip_force_n)
            await _until(
                running,
                lambda: service.firm or service.phase is Phase.FAULT,
                PHASE_S,
                lambda: f"{lift.stem}: not gripped ({service.phase})",
            )
            if service.state.fault is not None:
                raise SlipguardError(f"{lift.stem}: {service.state.fault}")
            await asyncio.sleep(STILL_S)
            await controls.lift(protocol.lift_height_mm, protocol.lift_speed_mm_s)
            await _until(running, lambda: service.phase is not Phase.LIFTING, PHASE_S, lambda: f"{lift.stem}: no end")
            await asyncio.sleep(protocol.hold_s)
        finally:
            if camera is not None:
                camera.give_to(None)
    if camera is not None and camera.lost:
        path.unlink(missing_ok=True)
        raise DeviceLost("the external camera is gone; plug it in and start again, the experiment goes on where it was")
    result = await asyncio.to_thread(result_of, path)
    if service.phase is Phase.HOLDING:
        await controls.lower()
        await _until(running, lambda: service.phase is Phase.HOLDING, PHASE_S, lambda: f"{lift.stem}: not lowered")
    error = result.errors["fused"].mean_deg if "fused" in result.errors else None
    told = result.problem or ("no turn told" if error is None else f"error {error:.2f}°")
    if await asyncio.to_thread(ask, f"{lift.stem}: {told}. Hold the object; the jaws open"):
        await controls.release()
        await _until(running, lambda: service.phase is Phase.IDLE, PHASE_S, lambda: f"{lift.stem}: not released")
    else:
        raise SlipguardError(f"{lift.stem}: stopped with the object held; `slipguard ctl release` lets go")


async def _until(
    running: asyncio.Task[None], reached: Callable[[], bool], timeout_s: float, otherwise: Callable[[], str]
) -> None:
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + timeout_s
    while not reached():
        if running.done():
            running.result()
            raise SlipguardError("the daemon's service ended by itself")
        if loop.time() >= deadline_s:
            raise SlipguardError(f"within {timeout_s:g} s: {otherwise()}")
        await asyncio.sleep(0.02)
