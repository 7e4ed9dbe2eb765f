"""A work shift at the cell: objects are gripped, lifted, held, lowered and released; sometimes a device fails.

Faults, disconnected cables, calibrations and pauses are drawn from one seed.
"""

from __future__ import annotations

import asyncio
import random
from collections import Counter
from collections.abc import Callable
from dataclasses import replace

from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import (
    CalibrateRequest,
    ClearRequest,
    DaemonRequest,
    GraspRequest,
    LiftRequest,
    LowerRequest,
    ReleaseRequest,
)
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.service import Service
from slipguard.devices import FINGERS
from slipguard.errors import CommandRefused
from slipguard.sim.catalogue import object_names
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World
from slipguard.tools.waiting import WaitTimeout, wait_until

STEP_S = 15.0
"""Longer than any phase takes."""
BACK_S = 40.0
"""A device that is connected again must be in use again by then."""
POLL_S = 0.05
HOLD_S, REST_S = (1.0, 10.0), (5.0, 60.0)
MANUAL_MM_S = 250.0
FAULT_S = (0.2, 6.0)
HELD_FAULTS = (
    *(((finger,), kind) for finger in FINGERS for kind in ("disconnect", "stall", "frozen", "corrupt")),
    (FINGERS, "disconnect"),
    (FINGERS, "stall"),
    (("gripper",), "disconnect"),
    (("gripper",), "timeout"),
    (("gripper",), "fault"),
    (("arm",), "disconnect"),
    (("arm",), "timeout"),
    (("arm",), "protective_stop"),
    (("arm",), "emergency_stop"),
)
HELD_FAULT_SHARE, CALIBRATION_SHARE = 0.4, 0.1
"""Shares of cycles with a fault while holding, and with a calibration."""


def place_object(world: World, name: str, seed: int, fps: float, now_s: float) -> None:
    """Place an object between the jaws; from then on the cameras deliver `fps` frames per second."""
    drawn = scenario(name, seed)
    left, right = (replace(one, fps=fps) for one in (drawn.left, drawn.right))
    world.place(replace(drawn, left=left, right=right), now_s)


class WorkShift:
    """Operates one service on one world; `counts` tallies events."""

    def __init__(self, service: Service, world: World, seed: int, fps: float) -> None:
        self.counts: Counter[str] = Counter()
        self._service, self._world, self._fps = service, world, fps
        self._handlers = RequestHandlers(service)
        self._random = random.Random(seed)
        self._seed = seed
        self._objects = object_names("test")
        self._slipping = False
        service.observers.append(self._decided)

    def _decided(self, decision: Decision) -> None:
        slipping = decision.state_before.grasp.held.slip is not None
        self.counts["slips"] += slipping and not self._slipping
        self.counts["tightenings"] += decision.output.hold_force_n is not None
        self.counts["cycles of the loop"] += 1
        self._slipping = slipping

    async def start(self) -> None:
        """Wait for the devices and take the background images."""
        await self._until(lambda: not self._service.waiting_for, BACK_S, "the devices are not ready")
        await self._until_accepted(CalibrateRequest())

    async def cycle(self, number: int) -> None:
        """Handle one object. Raises WaitTimeout if a step does not end."""
        service, now = self._service, asyncio.get_running_loop().time
        name = self._objects[number % len(self._objects)]
        place_object(self._world, name, self._seed + number, self._fps, now())
        try:
            await self._carry(name)
        except CommandRefused:
            self.counts["refused"] += 1
        await self._end_fault()
        self.counts["dropped"] += self._world.truth(now()).dropped is not None
        await self._until_accepted(ReleaseRequest(confirm=True))
        await self._until(lambda: service.phase is Phase.IDLE, STEP_S, f"{name}: not released")
        self._world.clear(now())
        await self._lower_manually()
        self.counts["cycles"] += 1
        await self._rest()

    async def _lower_manually(self) -> None:
        """Lower the arm manually, as after a fault while lifted: otherwise it reaches its upper limit."""
        now = asyncio.get_running_loop().time
        self._world.command_lift(now(), -self._world.arm_state(now()).height_mm, MANUAL_MM_S)
        await self._until(lambda: not self._world.arm_state(now()).moving, STEP_S, "the arm does not come down")

    async def _carry(self, name: str) -> None:
        service, handlers = self._service, self._handlers
        await handlers.submit(GraspRequest())
        await self._until(lambda: service.ready_to_lift or self._over(), STEP_S, f"{name}: not gripped")
        if self._over():
            return
        await self._until_accepted(LiftRequest(), self._over)
        await self._until(lambda: service.phase is not Phase.LIFTING, STEP_S, f"{name}: the lift does not end")
        self.counts["lifts"] += 1
        await asyncio.sleep(self._random.uniform(*HOLD_S))
        if self._random.random() < HELD_FAULT_SHARE:
            await self._fault(*self._random.choice(HELD_FAULTS))
        await self._until(lambda: service.ready_to_lift or self._over(), STEP_S, f"{name}: not settled")
        if service.phase is Phase.HOLDING:
            await self._until_accepted(LowerRequest(), self._over)
            await self._until(lambda: service.phase is not Phase.LOWERING, STEP_S, f"{name}: the lowering does not end")

    def _over(self) -> bool:
        return self._service.phase in (Phase.FAULT, Phase.IDLE)

    async def _fault(self, devices: tuple[str, ...], kind: str) -> None:
        """Let devices fail for a while and clear the latched fault."""
        self.counts[f"{' and '.join(devices)}: {kind}"] += 1
        for device in devices:
            self._world.faults.fail(device, kind)
        await asyncio.sleep(self._random.uniform(*FAULT_S))
        for device in devices:
            self._world.faults.repair(device, kind)
        await self._until(lambda: not self._service.waiting_for, BACK_S, f"{devices}: not back after {kind}")
        await self._end_fault()

    async def _end_fault(self) -> None:
        """Clear a latched fault; its cause may last a moment longer. Raises WaitTimeout if it keeps coming back."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + BACK_S
        while (fault := self._service.state.fault) is not None:
            if loop.time() > deadline_s:
                raise WaitTimeout(f"faults kept coming back for {BACK_S:g} s although cleared; the last: {fault}")
            await self._until_accepted(ClearRequest())
            self.counts[f"cleared: {fault.code}"] += 1
            await asyncio.sleep(POLL_S)

    async def _until_accepted(self, request: DaemonRequest, over: Callable[[], bool] = lambda: False) -> None:
        """Repeat a request until it is accepted: a device, or a busy machine, may need a moment.

        over: whether it has become pointless; then CommandRefused is raised.
        """
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + BACK_S
        while True:
            try:
                await self._handlers.submit(request)
                return
            except CommandRefused as refusal:
                if over():
                    raise
                if loop.time() > deadline_s:
                    raise WaitTimeout(f"still refused after {BACK_S:g} s: {refusal}") from None
            await asyncio.sleep(POLL_S)

    async def _rest(self) -> None:
        """Pause without an object; sometimes calibrate the sensors."""
        if self._random.random() < CALIBRATION_SHARE:
            await self._until_accepted(CalibrateRequest(force=True))
            self.counts["calibrations"] += 1
        await asyncio.sleep(self._random.uniform(*REST_S))

    async def _until(self, reached: Callable[[], bool], within_s: float, otherwise: str) -> None:
        def status() -> str:
            return f"{otherwise} ({self._service.phase}; {'; '.join(self._service.event_log.lines[-3:])})"

        await wait_until(None, reached, within_s, status, POLL_S)
