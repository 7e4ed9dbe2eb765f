"""The experiment on a real cell: a person places the objects, slipguard grips, lifts, records, lowers, lets go.

Whatever goes wrong, the grip stays and the arm stands; the jaws open only when the person says so in a word.
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
from slipguard.evaluation.external_camera import ExternalCamera
from slipguard.evaluation.intrinsics import Intrinsics
from slipguard.evaluation.lift_file import LiftRecorder, encoded
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.evaluation.runner import prepare, recording_path, result_of
from slipguard.tools.waiting import WaitTimeout, wait_until
from slipguard.web.sockets import bind

READY_S = 20.0
PHASE_S = 30.0
SLACK = 1.5
"""An arm may take this much longer than height and speed say, and `PHASE_S` besides."""
STILL_S = 1.0
STOP_S = 1.0
LOW_MM = 1.0
RELEASE = "release"
Ask = Callable[[str, str], Awaitable[bool]]
"""Shows a line and waits for a word, "" for Enter alone; False where the person stops instead."""


@contextlib.contextmanager
def in_the_daemons_place(socket_path: Path) -> Iterator[None]:
    """No daemon starts meanwhile. Raises SlipguardError where one runs, ConfigError where the socket cannot be made."""
    with contextlib.closing(bind(socket_path)):
        yield


async def run_on_cell(
    out: Path, protocol: LiftProtocol, service: Service, camera: ExternalCamera | None, intrinsics: Intrinsics, ask: Ask
) -> None:
    """Do what is still missing with a service that is not yet running.

    camera: None where somebody films the lifts and puts the films beside the recordings.
    Raises SlipguardError where the experiment cannot go on, and when cancelled: the arm is stopped, the grip kept, and
    the line says so. What was done is kept.
    """
    if service.config.guard.mode == "guard":
        raise ConfigError('guard.mode = "guard": slipguard does not move the arm then; the experiment needs "lift"')
    todo = prepare(out, protocol)
    running = asyncio.create_task(service.run())
    cell = _Cell(out, protocol, service, RequestHandlers(service), camera, intrinsics, running, ask)
    try:
        await cell.do(todo)
    except asyncio.CancelledError:
        why = "interrupted"
    except SlipguardError as error:
        why = str(error)
    else:
        return
    finally:
        stands = await _stopped(service)
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    raise SlipguardError(f"{why}{_left_behind(service, stands)}") from None


class _DoesNotCountError(SlipguardError):
    """The lift must be done again; the next one may go well."""


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

    async def do(self, todo: list[PlannedLift]) -> None:
        service = self.service
        await wait_until(self.running, lambda: not service.waiting_for, READY_S, lambda: "; ".join(service.waiting_for))
        if not self.protocol.guard:
            await self.handlers.submit(GuardRequest(on=False))
        for lift in todo:
            line = f"{lift.stem}: place {lift.thing.name} so that the lift turns it by about {lift.target_deg:.0f}°"
            if not await self.ask(line, ""):
                return
            await self._lift(lift)

    async def _lift(self, lift: PlannedLift) -> None:
        """From the grip to the open jaws. An object in the air is lowered before anything else."""
        trouble: SlipguardError | None = None
        try:
            await self._record(lift)
        except WaitTimeout:
            raise
        except SlipguardError as error:
            trouble = error
            if self.service.phase is Phase.IDLE:
                raise
        told = [f"{trouble}; this lift does not count" if trouble is not None else ""]
        told.append(await self._lower(lift))
        if trouble is None:
            told.insert(0, await self._analysed(lift))
        await self._release(lift, "; ".join(filter(None, told)))
        if trouble is not None and not isinstance(trouble, _DoesNotCountError | CommandRefused):
            raise trouble

    async def _record(self, lift: PlannedLift) -> None:
        service, protocol = self.service, self.protocol
        loop = asyncio.get_running_loop()
        with LiftRecorder(recording_path(self.out, lift), service, protocol, lift, self.intrinsics, None) as file:

            def take(picture: NDArray[np.uint8]) -> None:
                at_s = loop.time()
                jpeg = encoded(picture)
                with contextlib.suppress(RuntimeError):  # a late picture, and the loop is closed
                    loop.call_soon_threadsafe(file.camera, at_s, jpeg)

            if self.camera is not None:
                self.camera.give_to(take)
            try:
                await self.handlers.submit(GraspRequest(force_n=lift.thing.grip_force_n or protocol.grip_force_n))
                ended = (Phase.FAULT, Phase.IDLE)
                await wait_until(
                    self.running,
                    lambda: service.ready_to_lift or service.phase in ended,
                    PHASE_S,
                    lambda: f"{lift.stem}: not gripped ({service.phase})",
                )
                self._check(lift)
                await asyncio.sleep(STILL_S)
                self._check(lift)
                await self.handlers.submit(
                    LiftRequest(height_mm=protocol.lift_height_mm, speed_mm_s=protocol.lift_speed_mm_s)
                )
                limit_s = self._limit_s(protocol.lift_height_mm, protocol.lift_speed_mm_s)
                await wait_until(
                    self.running,
                    lambda: service.phase is not Phase.LIFTING,
                    limit_s,
                    lambda: f"{lift.stem}: the lift does not end",
                )
                if service.phase is Phase.HOLDING:
                    await asyncio.sleep(protocol.hold_s)
                self._check(lift)
            finally:
                if self.camera is not None:
                    self.camera.give_to(None)

    def _check(self, lift: PlannedLift) -> None:
        if self.service.state.fault is not None:
            raise _DoesNotCountError(str(self.service.state.fault))
        if self.service.phase is Phase.IDLE:
            raise SlipguardError(f"{lift.stem}: the jaws closed on nothing; place the object between them, start again")
        if self.camera is not None and self.camera.lost:
            raise DeviceLost(
                "the external camera is gone; plug it in and start again, the experiment goes on where it was"
            )

    async def _lower(self, lift: PlannedLift) -> str:
        """Back to where the lift began; why it is not there, "" if it is."""
        service, guard = self.service, self.service.config.guard
        up_mm = _up_mm(service)
        if service.phase is not Phase.HOLDING or up_mm < LOW_MM:
            return ""
        try:
            await wait_until(
                self.running,
                lambda: service.ready_to_lift or service.phase is not Phase.HOLDING,
                PHASE_S,
                lambda: f"{lift.stem}: not calm enough to be lowered",
            )
            await self.handlers.submit(LowerRequest())
        except CommandRefused as error:
            return str(service.state.fault or error)
        limit_s = self._limit_s(up_mm, guard.tuning.lower_speed_mm_s)
        await wait_until(
            self.running,
            lambda: service.phase is not Phase.LOWERING,
            limit_s,
            lambda: f"{lift.stem}: the lowering does not end",
        )
        return str(service.state.fault or "")

    async def _analysed(self, lift: PlannedLift) -> str:
        try:
            result = await asyncio.to_thread(result_of, recording_path(self.out, lift))
        except (SlipguardError, OSError) as error:
            return f"recorded, but not analysed ({error})"
        error_deg = result.errors["fused"].mean_deg if "fused" in result.errors else None
        return result.problem or ("no turn told" if error_deg is None else f"error {error_deg:.2f}°")

    async def _release(self, lift: PlannedLift, told: str) -> None:
        service, up_mm = self.service, _up_mm(self.service)
        where = f". It hangs {up_mm:.0f} mm up" if up_mm >= LOW_MM else ""
        if not await self.ask(f"{lift.stem}: {told}{where}. Hold the object; the jaws open", RELEASE):
            raise SlipguardError(f"{lift.stem}: stopped before the release")
        await self.handlers.submit(ReleaseRequest(confirm=True))
        ended = (Phase.IDLE, Phase.FAULT)
        await wait_until(self.running, lambda: service.phase in ended, PHASE_S, lambda: f"{lift.stem}: not released")
        if service.state.fault is not None:
            raise SlipguardError(f"{lift.stem}: {service.state.fault}")

    def _limit_s(self, height_mm: float, speed_mm_s: float) -> float:
        return PHASE_S + SLACK * height_mm / min(speed_mm_s, self.service.config.guard.tuning.probe_speed_mm_s)


def _up_mm(service: Service) -> float:
    """How far above the place where the lift began; 0 where that is not known."""
    arm, ground_mm = service.arm.newest, service.state.ground_mm
    return 0.0 if arm is None or ground_mm is None else arm.height_mm - ground_mm


async def _stopped(service: Service) -> bool:
    """Stop an arm in motion; whether it was told, or had no need to be.

    Sent again and again, for the law may want the arm to go on until the service is cancelled.
    """
    arm = service.arm
    stands = service.phase not in MOVING and arm.newest is not None and not arm.newest.moving
    if stands or service.phase is Phase.IDLE:
        return True
    told = asyncio.Event()
    try:
        async with asyncio.timeout(STOP_S):
            while not told.is_set():
                service.stop_arm(told.set)
                with contextlib.suppress(TimeoutError):
                    await asyncio.wait_for(told.wait(), STOP_S / 10)
    except TimeoutError:
        return False
    return True


def _left_behind(service: Service, stands: bool) -> str:
    """What the person must know and do, "" where nothing is held and the arm stands."""
    arm = "the arm stands" if stands else "the arm could not be told to stop: stop it by its own button"
    if service.phase in AT_STAKE or service.phase is Phase.FAULT:
        return f"; {arm} and the grip is kept; to let go, start `slipguard run`, then `slipguard ctl release`"
    return "" if stands else f"; {arm}"
