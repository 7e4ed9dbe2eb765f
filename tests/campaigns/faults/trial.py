"""One run: an object is gripped, lifted, held and put down, and one to three things go wrong meanwhile."""

from __future__ import annotations

import asyncio
import copy
from dataclasses import dataclass, field

import numpy as np

from slipguard.control.state import Phase
from slipguard.daemon.loop.virtual_time import VirtualTimeLoop, run_virtual
from slipguard.sim.catalogue import object_names
from slipguard.sim.world import World
from tests.campaigns.faults.kinds import MOMENTS, PlannedFault, draw
from tests.campaigns.faults.naming import WatchedFault, holding
from tests.campaigns.faults.operator import Operator
from tests.campaigns.faults.rig import CampaignCell

TICK_S = 0.01
RUN_S = 16.0
AFTER_S = 3.0
"""What a held object would do is looked at for so long."""
LOOSER_N = 0.01
WIDER_MM = 0.01
HINDERED_S = 1.0
"""A drop so soon after a fault that keeps the guard from seeing or gripping is not the law's."""
NEAR = frozenset({"arm.protective_stop", "arm.emergency_stop"})
"""Stops in which a person may be near: nothing may press harder."""
HALTED_S = 0.15
"""The jaws rest so long after such a stop began, or after what kept slipguard from halting them has ended."""
HARMLESS = frozenset({"duplicate", "late", "stuck"})
"""Faults that keep the guard from nothing: it still sees, grips and stops."""


@dataclass(frozen=True, slots=True)
class TrialResult:
    """What came of one run. named: kind and how long it took to be named; unnamed: which were not, in time.

    avoidable: dropped, though holding still would have kept it, or the guard could have. openings: how often the jaws
    opened or loosened unasked. presses: for how many ticks of an arm's own stop the force rose. lines: the log, with
    its times.
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
        """Whether anything happened that must not."""
        return bool(self.avoidable or self.openings or self.presses or self.unnamed or self.crashes or self.leaked)


@dataclass
class _Trial:
    rig: CampaignCell
    person: Operator
    plans: tuple[PlannedFault, ...]
    began_s: float
    watched: list[WatchedFault] = field(default_factory=list)
    before: list[World] = field(default_factory=list)
    """The world as it was when a fault began."""
    openings: int = 0
    presses: int = 0
    near_s: float = np.inf
    """Since when a person may be near, with nothing that keeps slipguard from halting the jaws."""
    near_n: float = np.inf
    looked_s: float = -np.inf
    taken: bool = False
    hindered_s: float = -np.inf
    tightest_n: float = 0.0
    narrowest_mm: float = np.inf
    dropped: str | None = None
    avoidable: bool = False

    @property
    def over(self) -> bool:
        """Let go of, and everything that was to go wrong has."""
        begun = len(self.watched) == len(self.plans)
        lasting = any(one.active and one.plan.lasts for one in self.watched)
        return begun and not lasting and self.person.asked and self.rig.alive and self.rig.service.phase is Phase.IDLE

    async def go_wrong(self, plan: PlannedFault) -> None:
        """One fault from beginning to end."""
        rig, kind = self.rig, plan.kind
        await asyncio.sleep(self.began_s + plan.at_s - rig.now_s)
        watched = WatchedFault(plan, rig.now_s, held=holding(rig))
        self.watched.append(watched)
        self.before.append(copy.deepcopy(rig.world))
        self._hinder(plan)
        if kind.name == "loop.late":
            loop = asyncio.get_running_loop()
            assert isinstance(loop, VirtualTimeLoop)
            loop.stand_still(plan.for_s)
        elif kind.name == "daemon.killed":
            await rig.kill()
            await asyncio.sleep(plan.for_s)
            rig.start()
            self._hinder(plan)
        elif kind.name == "object.taken":
            self.taken = True
            rig.world.clear(rig.now_s)
        else:
            self._switch(plan, on=True)
        if plan.lasts:
            await asyncio.sleep(plan.for_s)
            self._switch(plan, on=False)
            self._hinder(plan)
            watched.active = False

    def _switch(self, plan: PlannedFault, *, on: bool) -> None:
        device, fault = plan.kind.device, plan.kind.fault
        if fault == "mirrored":
            (self.rig.mirrored.add if on else self.rig.mirrored.discard)(device)
            if device in self.rig.sights:
                self.rig.sights[device].mirrored = on
        elif on:
            self.rig.world.faults.fail(device, fault)
        else:
            self.rig.world.faults.repair(device, fault)

    def _hinder(self, plan: PlannedFault) -> None:
        if plan.kind.fault not in HARMLESS or plan.kind.name == "loop.late":
            self.hindered_s = self.rig.now_s

    def look(self) -> None:
        """Once a tick: the grip against what it was, every fault against what was said."""
        rig, truth = self.rig, self.rig.truth
        for watched in self.watched:
            watched.look(rig, TICK_S)
        if any(
            one.active and one.plan.kind.fault not in HARMLESS
            for one in self.watched
            if one.plan.kind.name not in MOMENTS
        ):
            self.hindered_s = rig.now_s
        if self.person.asked or self.taken or self.dropped is not None:
            return
        if truth.dropped is not None:
            self._drop(truth.dropped)
            return
        width_mm = rig.world.gripper_state(rig.now_s).width_mm
        looser = truth.force_n < self.tightest_n - LOOSER_N
        wider = truth.in_contact and width_mm > self.narrowest_mm + WIDER_MM
        self.openings += looser or wider
        self._look_near(truth.force_n)
        self.tightest_n, self.narrowest_mm = max(self.tightest_n, truth.force_n), min(self.narrowest_mm, width_mm)

    def _look_near(self, force_n: float) -> None:
        """The force against what it was when the arm's own stop had just halted the jaws."""
        now_s, stood_still = self.rig.now_s, self.rig.now_s - self.looked_s > 2 * TICK_S
        self.looked_s = now_s
        active = {one.plan.kind.name for one in self.watched if one.active} - MOMENTS
        hindered = any(name.startswith(("gripper.", "arm.")) for name in active - NEAR)
        if not active & NEAR or hindered or stood_still or not self.rig.alive:
            self.near_s = self.near_n = np.inf
            return
        self.near_s = min(self.near_s, now_s)
        if now_s - self.near_s < HALTED_S:
            return
        self.near_n = min(self.near_n, force_n)
        self.presses += force_n > self.near_n + LOOSER_N

    def _drop(self, why: str) -> None:
        """Would it have stayed if nothing had moved since one of the faults, or was the guard free to hold it?"""
        self.dropped = why
        rig = self.rig
        within = rig.truth.needed_force_n <= rig.params.guard.force_max_n
        free = rig.now_s - self.hindered_s > HINDERED_S
        self.avoidable = (free and within) or any(_stays(world, rig.now_s) for world in self.before)


def _stays(world: World, until_s: float) -> bool:
    """Whether the object would still be there had the arm been stopped and the grip kept from then on."""
    for device in ("left", "right", "gripper", "arm"):
        world.faults.repair(device)
    begun_s = world.truth(0.0).time_s
    world.command_stop(begun_s)
    return world.truth(until_s + AFTER_S).dropped is None


def trial(seed: int) -> TrialResult:
    """The run of that seed, always the same."""
    rng = np.random.default_rng([seed, 5])
    names = object_names("test")
    object_name = names[int(rng.integers(len(names)))]
    guard: dict[str, object] = {"on_force_limit": str(rng.choice(["stop", "lower"]))}
    return run_virtual(_run(seed, object_name, guard, draw(rng, seed)))


async def _run(seed: int, object_name: str, guard: dict[str, object], plans: tuple[PlannedFault, ...]) -> TrialResult:
    loop, lines = asyncio.get_running_loop(), list[str]()
    began_s = loop.time()
    before = asyncio.all_tasks()

    def heard(line: str) -> None:
        lines.append(f"{loop.time() - began_s:6.2f} {line}")
        for watched in run.watched:
            watched.hear(line)

    rig = CampaignCell(object_name, seed, guard, heard)
    loop.set_exception_handler(lambda _, context: rig.crashes.append(str(context.get("exception", context["message"]))))
    run = _Trial(rig, Operator(rig, began_s), plans, began_s)
    rig.place()
    rig.start()
    tasks = [asyncio.create_task(run.person.work(), name="person")]
    tasks += [asyncio.create_task(run.go_wrong(plan), name=plan.kind.name) for plan in plans]
    while loop.time() - began_s < RUN_S:
        await asyncio.sleep(TICK_S)
        run.look()
        if rig.crashes or run.over:
            break
    for task in tasks:
        task.cancel()
    ends = await asyncio.gather(*tasks, return_exceptions=True)
    rig.crashes += [repr(end) for end in ends if isinstance(end, Exception)]
    await rig.stop()
    await asyncio.sleep(0)
    left = [one.get_name() for one in asyncio.all_tasks() - before if not one.done()]
    asked = 1 if run.person.asked else 0
    return TrialResult(
        seed,
        object_name,
        plans,
        run.dropped,
        run.avoidable,
        run.openings + max(0, rig.releases - asked * rig.releases),
        run.presses,
        tuple((one.plan.kind.name, one.named_after_s) for one in run.watched if one.named_after_s is not None),
        tuple(one.plan.kind.name for one in run.watched if one.unnamed),
        tuple(one.plan.kind.name for one in run.watched if one.due),
        tuple(rig.crashes),
        tuple(left),
        tuple(lines),
    )
