"""The experiment on a real cell: an operator places the objects; slipguard grips, lifts, records, lowers and releases.

After any error the grip is kept and the arm is stopped; the jaws open only after the operator confirms.
"""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slipguard.control.state import AT_STAKE, MOVING, Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import GraspRequest, GuardRequest, LiftRequest, LowerRequest, ReleaseRequest
from slipguard.daemon.loop.service import Service
from slipguard.errors import CommandRefused, ConfigError, DeviceLost, SlipguardError
from slipguard.evaluation.camera_calibration import Intrinsics
from slipguard.evaluation.experiment import prepare, recording_path, result_of
from slipguard.evaluation.external_camera import ExternalCamera
from slipguard.evaluation.lift_recording import LiftRecorder, encode_jpeg
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.tools.waiting import WaitTimeout, wait_until
from slipguard.web.sockets import bind

READY_S = 20.0
PHASE_S = 30.0
SLACK = 1.5
"""Factor on the nominal duration of a motion, in addition to `PHASE_S`."""
STILL_S = 1.0
STOP_S = 1.0
LOW_MM = 1.0
RELEASE = "release"
Ask = Callable[[str, str], Awaitable[bool]]
"""Show a line and wait for a word, "" for Enter alone; return False if the operator stops instead."""


@contextlib.contextmanager
def daemon_socket_held(socket_path: Path) -> Iterator[None]:
    """Keep a daemon from starting. Raises SlipguardError if one runs, ConfigError if the socket cannot be created."""
    with contextlib.closing(bind(socket_path)):
        yield


async def run_on_cell(
    out: Path, protocol: LiftProtocol, service: Service, camera: ExternalCamera | None, intrinsics: Intrinsics, ask: Ask
) -> None:
    """Do the missing lifts with a service that is not running yet.

    Args:
        camera: None if the lifts are filmed separately and the videos placed next to the recordings.

    Raises:
        SlipguardError: the experiment cannot continue, or was cancelled. The arm is stopped and the grip kept, as the
            message says; recorded lifts are kept.
    """
    if service.config.guard.mode == "guard":
        raise ConfigError('guard.mode = "guard": slipguard does not move the arm in this mode; set it to "lift"')
    todo = prepare(out, protocol)
    running = asyncio.create_task(service.run())
    cell = _Cell(out, protocol, service, RequestHandlers(service), camera, intrinsics, running, ask)
    try:
        await cell.run(todo)
    except asyncio.CancelledError:
        why = "interrupted"
    except SlipguardError as error:
        why = str(error)
    else:
        return
    finally:
        stopped = await _stop_arm(service)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    raise SlipguardError(f"{why}{_final_state(service, stopped)}") from None


class _LiftInvalidError(SlipguardError):
    """The lift must be repeated; the next one may succeed."""


@dataclass(frozen=True, slots=True)
class _Cell:
    out: Path
    protocol: LiftProtocol
    service: Service
    handlers: RequestHandlers
    camera: ExternalCamera | None
    intrinsics: Intrinsics
    running: asyncio.Task[None]
    ask: Ask

    async def run(self, todo: list[PlannedLift]) -> None:
        service = self.service
        await wait_until(self.running, lambda: not service.waiting_for, READY_S, lambda: "; ".join(service.waiting_for))
        if not self.protocol.guard:
            await self.handlers.submit(GuardRequest(on=False))
        for lift in todo:
            line = f"{lift.stem}: place {lift.item.name} so that it rotates by about {lift.target_deg:.0f}° when lifted"
            if not await self.ask(line, ""):
                return
            await self._lift(lift)

    async def _lift(self, lift: PlannedLift) -> None:
        """Do one lift from grip to release. A lifted object is lowered even after an error."""
        failure: SlipguardError | None = None
        try:
            await self._record(lift)
        except WaitTimeout:
            raise
        except SlipguardError as error:
            failure = error
            if self.service.phase is Phase.IDLE:
                raise
        notes = [f"{failure}; this lift does not count" if failure is not None else ""]
        notes.append(await self._lower(lift))
        if failure is None:
            notes.insert(0, await self._analyze(lift))
        await self._release(lift, "; ".join(filter(None, notes)))
        if failure is not None and not isinstance(failure, _LiftInvalidError | CommandRefused):
            raise failure

    async def _record(self, lift: PlannedLift) -> None:
        service, protocol = self.service, self.protocol
        loop = asyncio.get_running_loop()
        with LiftRecorder(recording_path(self.out, lift), service, protocol, lift, self.intrinsics, None) as recorder:

            def record_image(image: NDArray[np.uint8]) -> None:
                at_s = loop.time()
                jpeg = encode_jpeg(image)
                with contextlib.suppress(RuntimeError):  # a late image after the loop is closed
                    loop.call_soon_threadsafe(recorder.camera, at_s, jpeg)

            if self.camera is not None:
                self.camera.send_to(record_image)
            try:
                await self.handlers.submit(GraspRequest(force_n=lift.item.grip_force_n or protocol.grip_force_n))
                ended = (Phase.FAULT, Phase.IDLE)
                await self._wait(lambda: service.ready_to_lift or service.phase in ended, PHASE_S, lift, "not gripped")
                self._check(lift)
                await asyncio.sleep(STILL_S)
                self._check(lift)
                await self.handlers.submit(
                    LiftRequest(height_mm=protocol.lift_height_mm, speed_mm_s=protocol.lift_speed_mm_s)
                )
                limit_s = self._limit_s(protocol.lift_height_mm, protocol.lift_speed_mm_s)
                await self._wait(lambda: service.phase is not Phase.LIFTING, limit_s, lift, "the lift does not end")
                if service.phase is Phase.HOLDING:
                    await asyncio.sleep(protocol.hold_s)
                self._check(lift)
            finally:
                if self.camera is not None:
                    self.camera.send_to(None)

    def _check(self, lift: PlannedLift) -> None:
        if self.service.state.fault is not None:
            raise _LiftInvalidError(str(self.service.state.fault))
        if self.service.phase is Phase.IDLE:
            raise SlipguardError(f"{lift.stem}: the jaws closed on nothing; place the object between them, start again")
        if self.camera is not None and self.camera.lost:
            raise DeviceLost(
                "the external camera is disconnected; connect it and start again, the experiment continues with the "
                "missing lifts"
            )

    async def _lower(self, lift: PlannedLift) -> str:
        """Lower the object to where the lift began; return why that failed, "" if it did not."""
        service, guard = self.service, self.service.config.guard
        lifted_mm = _lifted_mm(service)
        if service.phase is not Phase.HOLDING or lifted_mm < LOW_MM:
            return ""
        try:
            await self._wait(
                lambda: service.ready_to_lift or service.phase is not Phase.HOLDING,
                PHASE_S,
                lift,
                "not settled, so it cannot be lowered",
            )
            await self.handlers.submit(LowerRequest())
        except CommandRefused as error:
            return str(service.state.fault or error)
        limit_s = self._limit_s(lifted_mm, guard.tuning.lower_speed_mm_s)
        await self._wait(lambda: service.phase is not Phase.LOWERING, limit_s, lift, "the lowering does not end")
        return str(service.state.fault or "")

    async def _analyze(self, lift: PlannedLift) -> str:
        try:
            result = await asyncio.to_thread(result_of, recording_path(self.out, lift))
        except (SlipguardError, OSError) as error:
            return f"recorded, but not analyzed ({error})"
        error_deg = result.errors["fused"].mean_deg if "fused" in result.errors else None
        return result.problem or ("no estimate" if error_deg is None else f"error {error_deg:.2f}°")

    async def _release(self, lift: PlannedLift, note: str) -> None:
        service, lifted_mm = self.service, _lifted_mm(self.service)
        where = f". The object is {lifted_mm:.0f} mm above the table" if lifted_mm >= LOW_MM else ""
        if not await self.ask(f"{lift.stem}: {note}{where}. Hold the object; the jaws will open", RELEASE):
            raise SlipguardError(f"{lift.stem}: stopped before the release")
        await self.handlers.submit(ReleaseRequest(confirm=True))
        await self._wait(lambda: service.phase in (Phase.IDLE, Phase.FAULT), PHASE_S, lift, "not released")
        if service.state.fault is not None:
            raise SlipguardError(f"{lift.stem}: {service.state.fault}")

    async def _wait(self, reached: Callable[[], bool], limit_s: float, lift: PlannedLift, otherwise: str) -> None:
        await wait_until(
            self.running, reached, limit_s, lambda: f"{lift.stem}: {otherwise} (phase {self.service.phase})"
        )

    def _limit_s(self, height_mm: float, speed_mm_s: float) -> float:
        return PHASE_S + SLACK * height_mm / min(speed_mm_s, self.service.config.guard.tuning.lift_off_speed_mm_s)


def _lifted_mm(service: Service) -> float:
    """Return the height above where the lift began; 0 if that is not known."""
    arm, ground_mm = service.arm.newest, service.state.arm.ground_mm
    return 0.0 if arm is None or ground_mm is None else arm.height_mm - ground_mm


async def _stop_arm(service: Service) -> bool:
    """Stop a moving arm; return whether the command was sent or not needed.

    It is sent repeatedly, because the controller may move the arm until the service is cancelled.
    """
    arm = service.arm
    at_rest = service.phase not in MOVING and arm.newest is not None and not arm.newest.moving
    if at_rest or service.phase is Phase.IDLE:
        return True
    sent = asyncio.Event()
    try:
        async with asyncio.timeout(STOP_S):
            while not sent.is_set():
                service.stop_arm(sent.set)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(sent.wait(), STOP_S / 10)
    except TimeoutError:
        return False
    return True


def _final_state(service: Service, stopped: bool) -> str:
    """Return what the operator must know and do, "" if nothing is held and the arm is stopped."""
    arm = "the arm is stopped" if stopped else "the arm could not be stopped: use its stop button"
    if service.phase in AT_STAKE or service.phase is Phase.FAULT:
        return f"; {arm} and the grip is kept: start `slipguard run`, support the object, then `slipguard ctl release`"
    return "" if stopped else f"; {arm}"
