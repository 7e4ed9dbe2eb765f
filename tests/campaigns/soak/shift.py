"""A shift at the cell: object after object is gripped, lifted, held, lowered, let go, and now and then a device fails.

Every object is one that turns and slides in the lift. Faults, lost cables, calibrations and pauses are drawn from one
seed.
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
from slipguard.daemon.loop.service import FINGERS, Service
from slipguard.errors import CommandRefused
from slipguard.sim.catalogue import object_names
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World
from slipguard.tools.waiting import WaitTimeout, wait_until

STEP_S = 15.0
"""Longer than any phase takes."""
BACK_S = 40.0
"""A device that is there again is in use again by then."""
LOOK_S = 0.05
HOLD_S, REST_S = (1.0, 10.0), (5.0, 60.0)
CALM_HOLD_S = 2.0
BY_HAND_MM_S = 250.0
TROUBLE_S = (0.2, 6.0)
HELD_TROUBLES = (
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
IDLE_TROUBLES = tuple((device,) for device in (*FINGERS, "gripper", "arm"))
HELD_TROUBLE, IDLE_TROUBLE, CALIBRATION = 0.4, 0.15, 0.05
"""Share of the cycles with a fault while something is held, with a cable out and in later, with a calibration."""


def place_object(world: World, name: str, seed: int, fps: float, now_s: float) -> None:
    """Put an object between the jaws; the cameras deliver `fps` frames a second from then on."""
    drawn = scenario(name, seed)
    left, right = (replace(one, fps=fps) for one in (drawn.left, drawn.right))
    world.place(replace(drawn, left=left, right=right), now_s)


class WorkShift:
    """Drives one service on one world. counts: what happened, and how often. calm: no device fails, no long rests."""

    def __init__(self, service: Service, world: World, seed: int, fps: float, *, calm: bool = False) -> None:
        self.counts: Counter[str] = Counter()
        self._service, self._world, self._fps, self._calm = service, world, fps, calm
        self._handlers = RequestHandlers(service)
        self._random = random.Random(seed)
        self._seed = seed
        self._objects = object_names("test")
        self._slipping = False
        service.observers.append(self._decided)

    def _decided(self, decision: Decision) -> None:
        slipping = decision.memory.grasp.slip is not None
        self.counts["slips"] += slipping and not self._slipping
        self.counts["tightenings"] += decision.command.hold_force_n is not None
        self.counts["turns of the loop"] += 1
        self._slipping = slipping

    async def start(self) -> None:
        """Wait for the devices and take the no-contact images."""
        await self._until(lambda: not self._service.waiting_for, BACK_S, "the devices are not ready")
        await self._patiently(CalibrateRequest())

    async def cycle(self, number: int) -> None:
        """One object. Raises Stuck where something does not come to its end."""
        service, now = self._service, asyncio.get_running_loop().time
        name = self._objects[number % len(self._objects)]
        place_object(self._world, name, self._seed + number, self._fps, now())
        try:
            await self._carry(name)
        except CommandRefused:
            self.counts["refused"] += 1
        await self._end_fault()
        self.counts["dropped"] += self._world.truth(now()).dropped is not None
        await self._patiently(ReleaseRequest(confirm=True))
        await self._until(lambda: service.phase is Phase.IDLE, STEP_S, f"{name}: not released")
        self._world.clear(now())
        await self._bring_down()
        self.counts["cycles"] += 1
        if not self._calm:
            await self._rest()

    async def _bring_down(self) -> None:
        """By hand, as after a fault in the air: an arm that only ever goes up has its ceiling."""
        now = asyncio.get_running_loop().time
        self._world.command_lift(now(), -self._world.arm_state(now()).height_mm, BY_HAND_MM_S)
        await self._until(lambda: not self._world.arm_state(now()).moving, STEP_S, "the arm does not come down")

    async def _carry(self, name: str) -> None:
        service, handlers = self._service, self._handlers
        await handlers.submit(GraspRequest())
        await self._until(lambda: service.firm or self._over(), STEP_S, f"{name}: not gripped")
        if self._over():
            return
        await handlers.submit(LiftRequest())
        await self._until(lambda: service.phase is not Phase.LIFTING, STEP_S, f"{name}: the lift does not end")
        self.counts["lifts"] += 1
        await asyncio.sleep(CALM_HOLD_S if self._calm else self._random.uniform(*HOLD_S))
        if not self._calm and self._random.random() < HELD_TROUBLE:
            await self._trouble(*self._random.choice(HELD_TROUBLES))
        await self._until(lambda: service.firm or self._over(), STEP_S, f"{name}: not calm")
        if service.phase is Phase.HOLDING:
            await handlers.submit(LowerRequest())
            await self._until(lambda: service.phase is not Phase.LOWERING, STEP_S, f"{name}: the lowering does not end")

    def _over(self) -> bool:
        return self._service.phase in (Phase.FAULT, Phase.IDLE)

    async def _trouble(self, devices: tuple[str, ...], kind: str) -> None:
        """Let devices fail for a while, as long as the object is held, and clear what was latched."""
        self.counts[f"{' and '.join(devices)}: {kind}"] += 1
        for device in devices:
            self._world.faults.fail(device, kind)
        await asyncio.sleep(self._random.uniform(*TROUBLE_S))
        for device in devices:
            self._world.faults.repair(device, kind)
        await self._until(lambda: not self._service.waiting_for, BACK_S, f"{devices}: not back after {kind}")
        await self._end_fault()

    async def _end_fault(self) -> None:
        """Clear a latched fault; its cause may take a moment to be gone. Raises Stuck where it comes back and back."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + BACK_S
        while (fault := self._service.state.fault) is not None:
            if loop.time() > deadline_s:
                raise WaitTimeout(f"faults for {BACK_S:g} s, each cleared; the last: {fault}")
            await self._patiently(ClearRequest())
            self.counts[f"cleared: {fault.code}"] += 1
            await asyncio.sleep(LOOK_S)

    async def _patiently(self, request: DaemonRequest) -> None:
        """Repeat a request until it is not refused: a device, or a busy machine, may need a moment."""
        loop = asyncio.get_running_loop()
        deadline_s = loop.time() + BACK_S
        while True:
            try:
                await self._handlers.submit(request)
                return
            except CommandRefused as refusal:
                if loop.time() > deadline_s:
                    raise WaitTimeout(f"still refused after {BACK_S:g} s: {refusal}") from None
            await asyncio.sleep(LOOK_S)

    async def _rest(self) -> None:
        """Nothing is held: time passes, a cable comes out and in, the sensors are calibrated."""
        chance = self._random.random()
        if chance < IDLE_TROUBLE:
            await self._trouble(self._random.choice(IDLE_TROUBLES), "disconnect")
        elif chance < IDLE_TROUBLE + CALIBRATION:
            await self._patiently(CalibrateRequest(force=True))
            self.counts["calibrations"] += 1
        await asyncio.sleep(self._random.uniform(*REST_S))

    async def _until(self, reached: Callable[[], bool], within_s: float, otherwise: str) -> None:
        def how_it_stands() -> str:
            return f"{otherwise} ({self._service.phase}; {'; '.join(self._service.event_log.lines[-3:])})"

        await wait_until(None, reached, within_s, how_it_stands, LOOK_S)
