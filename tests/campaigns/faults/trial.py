"""One run: an object is gripped, lifted, held and lowered while one to three faults occur."""

from __future__ import annotations

import asyncio
import copy
from dataclasses import dataclass, field

import numpy as np

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import (
    ClearRequest,
    DaemonRequest,
    GraspRequest,
    LiftRequest,
    LowerRequest,
    ReleaseRequest,
)
from slipguard.daemon.loop.virtual_time import VirtualTimeLoop, run_virtual
from slipguard.errors import CommandRefused
from slipguard.sim.catalogue import object_names
from slipguard.sim.world import World
from tests.campaigns.faults.campaign_cell import CampaignCell
from tests.campaigns.faults.detection import MonitoredFault, holding
from tests.campaigns.faults.kinds import INSTANTANEOUS, PlannedFault, draw

TICK_S = 0.01
RUN_S = 16.0
AFTER_S = 3.0
"""How long a held object is simulated further to see whether it stays."""
LOOSER_N = 0.01
WIDER_MM = 0.01
IMPAIRED_S = 1.0
"""A drop this soon after a fault that impairs sensing or gripping is not the controller's fault."""
PERSON_NEARBY = frozenset({"arm.protective_stop", "arm.emergency_stop"})
"""Stops in which a person may be near the gripper: the force must not rise."""
HALTED_S = 0.15
"""The jaws rest this long after such a stop began, or after a fault that kept slipguard from halting them ended."""
HARMLESS = frozenset({"duplicate", "late", "stuck"})
"""Faults that do not impair sensing, gripping or stopping."""


POLL_S = 0.1
CLEAR_S = 0.6
LOWER_AFTER_S = 10.5


class Operator:
    """Operates one cell. release_requested: the operator has requested the jaws to open."""

    def __init__(self, cell: CampaignCell, began_s: float) -> None:
        self.release_requested = False
        self._cell, self._began_s = cell, began_s
        self._grasped = self._lifted = self._lowered = False
        self._cleared_s = 0.0

    async def work(self) -> None:
        """Work until cancelled."""
        while True:
            await asyncio.sleep(POLL_S)
            if self._cell.alive and not self.release_requested:
                await self._act()

    async def _act(self) -> None:
        cell, phase = self._cell, self._cell.service.phase
        if phase is Phase.FAULT and cell.now_s - self._cleared_s >= CLEAR_S:
            self._cleared_s = cell.now_s
            await self._accepted(ClearRequest())
        elif phase is Phase.IDLE and not self._grasped:
            self._grasped = await self._accepted(GraspRequest())
        elif phase is Phase.HOLDING and cell.service.ready_to_lift:
            await self._proceed()

    async def _proceed(self) -> None:
        """Lift, wait, lower, release."""
        if not self._lifted:
            self._lifted = await self._accepted(LiftRequest())
        elif self._cell.now_s - self._began_s < LOWER_AFTER_S:
            return
        elif not self._lowered:
            self._lowered = await self._accepted(LowerRequest(height_mm=max(self._cell.truth.height_mm, 1.0)))
        else:
            self.release_requested = True
            await self._accepted(ReleaseRequest(confirm=True))

    async def _accepted(self, request: DaemonRequest) -> bool:
        try:
            await self._cell.submit(request)
        except CommandRefused:
            return False
        return True


@dataclass(frozen=True, slots=True)
class TrialResult:
    """The result of one run.

    Attributes:
        avoidable: dropped, although holding still would have kept it, or the guard could have.
        openings: how often the jaws opened or loosened without a request.
        presses: for how many ticks of a protective or emergency stop the force rose.
        named: fault and how long it took to be named.
        unnamed: faults not named in time.
        lines: the log, with times.
    """

    seed: int
    object_name: str
    plans: tuple[PlannedFault, ...]
    dropped: str | None = None
    avoidable: bool = False
    openings: int = 0
    presses: int = 0
    named: tuple[tuple[str, float], ...] = ()
    unnamed: tuple[str, ...] = ()
    due: tuple[str, ...] = ()
    crashes: tuple[str, ...] = ()
    leaked: tuple[str, ...] = ()
    lines: tuple[str, ...] = ()

    @property
    def failed(self) -> bool:
        """Whether a safety rule was broken."""
        return bool(self.avoidable or self.openings or self.presses or self.unnamed or self.crashes or self.leaked)


@dataclass
class _Trial:
    cell: CampaignCell
    operator: Operator
    plans: tuple[PlannedFault, ...]
    began_s: float
    monitored: list[MonitoredFault] = field(default_factory=list)
    before: list[World] = field(default_factory=list)
    """The world when each fault began."""
    openings: int = 0
    presses: int = 0
    nearby_since_s: float = np.inf
    """Since when a person may be near, without a fault that keeps slipguard from halting the jaws."""
    nearby_force_n: float = np.inf
    checked_s: float = -np.inf
    taken: bool = False
    impaired_s: float = -np.inf
    tightest_n: float = 0.0
    narrowest_mm: float = np.inf
    dropped: str | None = None
    avoidable: bool = False

    @property
    def over(self) -> bool:
        """Whether the object was released and all faults have occurred."""
        begun = len(self.monitored) == len(self.plans)
        lasting = any(one.active and one.plan.lasts for one in self.monitored)
        return (
            begun
            and not lasting
            and self.operator.release_requested
            and self.cell.alive
            and self.cell.service.phase is Phase.IDLE
        )

    async def inject(self, plan: PlannedFault) -> None:
        """Run one fault from begin to end."""
        cell, kind = self.cell, plan.kind
        await asyncio.sleep(self.began_s + plan.at_s - cell.now_s)
        fault = MonitoredFault(plan, cell.now_s, held=holding(cell))
        self.monitored.append(fault)
        self.before.append(copy.deepcopy(cell.world))
        self._impair(plan)
        if kind.name == "loop.late":
            loop = asyncio.get_running_loop()
            assert isinstance(loop, VirtualTimeLoop)
            loop.stand_still(plan.for_s)
        elif kind.name == "daemon.killed":
            await cell.kill()
            await asyncio.sleep(plan.for_s)
            cell.start()
            self._impair(plan)
        elif kind.name == "object.taken":
            self.taken = True
            cell.world.clear(cell.now_s)
        else:
            self._switch(plan, on=True)
        if plan.lasts:
            await asyncio.sleep(plan.for_s)
            self._switch(plan, on=False)
            self._impair(plan)
            fault.active = False

    def _switch(self, plan: PlannedFault, *, on: bool) -> None:
        device, kind = plan.kind.device, plan.kind.fault
        if kind == "mirrored":
            (self.cell.mirrored.add if on else self.cell.mirrored.discard)(device)
            if device in self.cell.perception:
                self.cell.perception[device].mirrored = on
        elif on:
            self.cell.world.faults.fail(device, kind)
        else:
            self.cell.world.faults.repair(device, kind)

    def _impair(self, plan: PlannedFault) -> None:
        if plan.kind.fault not in HARMLESS or plan.kind.name == "loop.late":
            self.impaired_s = self.cell.now_s

    def check(self) -> None:
        """Check the grip and the monitored faults, once per tick."""
        cell, truth = self.cell, self.cell.truth
        for fault in self.monitored:
            fault.update(cell, TICK_S)
        if any(
            one.active and one.plan.kind.fault not in HARMLESS
            for one in self.monitored
            if one.plan.kind.name not in INSTANTANEOUS
        ):
            self.impaired_s = cell.now_s
        if self.operator.release_requested or self.taken or self.dropped is not None:
            return
        if truth.dropped is not None:
            self._drop(truth.dropped)
            return
        width_mm = cell.world.gripper_state(cell.now_s).width_mm
        looser = truth.force_n < self.tightest_n - LOOSER_N
        wider = truth.in_contact and width_mm > self.narrowest_mm + WIDER_MM
        self.openings += looser or wider
        self._check_nearby(truth.force_n)
        self.tightest_n, self.narrowest_mm = max(self.tightest_n, truth.force_n), min(self.narrowest_mm, width_mm)

    def _check_nearby(self, force_n: float) -> None:
        """Compare the force with that when a protective or emergency stop had just halted the jaws."""
        now_s, paused = self.cell.now_s, self.cell.now_s - self.checked_s > 2 * TICK_S
        self.checked_s = now_s
        active = {one.plan.kind.name for one in self.monitored if one.active} - INSTANTANEOUS
        impaired = any(name.startswith(("gripper.", "arm.")) for name in active - PERSON_NEARBY)
        if not active & PERSON_NEARBY or impaired or paused or not self.cell.alive:
            self.nearby_since_s = self.nearby_force_n = np.inf
            return
        self.nearby_since_s = min(self.nearby_since_s, now_s)
        if now_s - self.nearby_since_s < HALTED_S:
            return
        self.nearby_force_n = min(self.nearby_force_n, force_n)
        self.presses += force_n > self.nearby_force_n + LOOSER_N

    def _drop(self, why: str) -> None:
        """Record a drop; avoidable if holding still since a fault would have kept it, or the guard was not impaired."""
        self.dropped = why
        cell = self.cell
        within = cell.truth.needed_force_n <= cell.params.guard.force_max_n
        free = cell.now_s - self.impaired_s > IMPAIRED_S
        self.avoidable = (free and within) or any(_stays(world, cell.now_s) for world in self.before)


def _stays(world: World, until_s: float) -> bool:
    """Return whether the object would have stayed with the arm stopped and the grip kept."""
    for device in ("left", "right", "gripper", "arm"):
        world.faults.repair(device)
    begun_s = world.truth(0.0).time_s
    world.command_stop(begun_s)
    return world.truth(until_s + AFTER_S).dropped is None


def trial(seed: int) -> TrialResult:
    """Return the run of a seed; it is deterministic."""
    rng = np.random.default_rng([seed, 5])
    names = object_names("test")
    object_name = names[int(rng.integers(len(names)))]
    guard: dict[str, object] = {"on_force_limit": str(rng.choice(["stop", "lower"]))}
    return run_virtual(_run(seed, object_name, guard, draw(rng, seed)))


async def _run(seed: int, object_name: str, guard: dict[str, object], plans: tuple[PlannedFault, ...]) -> TrialResult:
    loop, lines = asyncio.get_running_loop(), list[str]()
    began_s = loop.time()
    before = asyncio.all_tasks()

    def on_line(line: str) -> None:
        lines.append(f"{loop.time() - began_s:6.2f} {line}")
        for fault in run.monitored:
            fault.read_line(line)

    cell = CampaignCell(object_name, seed, guard, on_line)
    loop.set_exception_handler(
        lambda _, context: cell.crashes.append(str(context.get("exception", context["message"])))
    )
    run = _Trial(cell, Operator(cell, began_s), plans, began_s)
    cell.place()
    cell.start()
    tasks = [asyncio.create_task(run.operator.work(), name="operator")]
    tasks += [asyncio.create_task(run.inject(plan), name=plan.kind.name) for plan in plans]
    while loop.time() - began_s < RUN_S:
        await asyncio.sleep(TICK_S)
        run.check()
        if cell.crashes or run.over:
            break
    for task in tasks:
        task.cancel()
    ends = await asyncio.gather(*tasks, return_exceptions=True)
    cell.crashes += [repr(end) for end in ends if isinstance(end, Exception)]
    await cell.stop()
    await asyncio.sleep(0)
    left = [one.get_name() for one in asyncio.all_tasks() - before if not one.done()]
    asked = 1 if run.operator.release_requested else 0
    return TrialResult(
        seed,
        object_name,
        plans,
        run.dropped,
        run.avoidable,
        run.openings + max(0, cell.releases - asked * cell.releases),
        run.presses,
        tuple((one.plan.kind.name, one.named_after_s) for one in run.monitored if one.named_after_s is not None),
        tuple(one.plan.kind.name for one in run.monitored if one.unnamed),
        tuple(one.plan.kind.name for one in run.monitored if one.due),
        tuple(cell.crashes),
        tuple(left),
        tuple(lines),
    )
