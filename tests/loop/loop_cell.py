"""A whole cell on the virtual clock: the real service, controller, fakes and world; only the images are replaced.

So a lift of eight seconds takes a fraction of one.
"""

from __future__ import annotations

import asyncio
import inspect
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from functools import partial, wraps
from typing import Any

import numpy as np
from loop_doubles import ClosableWorker, FlatSensor, LoggedArm, LoggedGripper, Memory, Oracle

from slipguard.config import Config, parse_config
from slipguard.control.control_step import control_step
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import DaemonRequest, GraspRequest, LiftRequest, LowerRequest, ReleaseRequest
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.service import Controller, Service
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import ThreadWorker, Worker
from slipguard.devices import FINGERS, DriverContext
from slipguard.sim.catalogue import find_object
from slipguard.sim.cell import WorldTruth
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World, WorldSettings

Scene = Callable[..., Coroutine[Any, Any, None]]


@dataclass
class Cell:
    """One service on a world of its own (or on the one it is given, as after a restart).

    guard, loop: sections of the configuration. declined: by finger, why it declines every cycle. threads: real workers
    instead of `latency_s`, for the real clock. watched: the grip is compared with the truth in every cycle.
    fingertip_mm: of the true sensors; configured_mm: the configured value, if it differs.
    """

    object_name: str = "wrench"
    seed: int = 0
    guard: dict[str, object] = field(default_factory=dict)
    loop: dict[str, object] = field(default_factory=dict)
    declined: dict[str, str] = field(default_factory=dict)
    controller: Controller = control_step
    latency_s: float = 0.006
    threads: bool = False
    fps: float = 60.0
    watched: bool = True
    world: World = None  # type: ignore[assignment]  # a new one, unless it is given
    calibrated: bool = True
    fingertip_mm: float = 0.0
    configured_mm: float | None = None
    messages: list[str] = field(default_factory=list)
    phases: list[Phase] = field(default_factory=list)
    ticks: int = 0
    observer_errors: int = 0
    """Errors of observers that a test expects."""
    loosened: str | None = None
    """The first moment at which the grip got weaker or wider without a release request."""
    tightest_n: float = 0.0
    narrowest_mm: float = 1e9

    def __post_init__(self) -> None:
        self.fresh = self.world is None
        start_mm = find_object(self.object_name).width_mm + 20.0 + 2.0 * self.fingertip_mm
        settings = WorldSettings(step_s=2e-3, start_width_mm=start_mm, fingertip_mm=self.fingertip_mm)
        world = self.world = self.world or World(settings, seed=self.seed)
        rng = np.random.default_rng([self.seed, 7])
        self.sensors = {name: FlatSensor(DriverContext(name, world)) for name in FINGERS}
        self.gripper = LoggedGripper(
            DriverContext("gripper", world), self.fingertip_mm if self.configured_mm is None else self.configured_mm
        )
        self.arm = LoggedArm(DriverContext("arm", world))
        self.workers: dict[str, ClosableWorker] = {}
        self.perceivers: dict[str, list[Oracle]] = {name: [] for name in FINGERS}
        self.store = Memory("SIM-L", "SIM-R") if self.calibrated else Memory()

        def make_worker(name: str) -> Worker:
            if self.threads:
                return ThreadWorker(name)
            self.workers[name] = ClosableWorker(self.latency_s)
            return self.workers[name]

        def maker(name: str) -> Callable[[str], Oracle]:
            def make(serial: str) -> Oracle:
                sign = 1.0 if name == "left" else -1.0
                made = Oracle(self.sensors[name].numbered_images, sign, rng, self.declined.get(name))
                self.perceivers[name].append(made)
                return made

            return make

        self.service = Service(
            self._config(),
            sensors=self.sensors,
            gripper=self.gripper,
            arm=self.arm,
            make_worker=make_worker,
            make_pipeline={name: maker(name) for name in FINGERS},
            store=self.store,
            controller=self.controller,
        )
        self.handlers = RequestHandlers(self.service)
        self.service.observers.append(self._watch)

    def _config(self) -> Config:
        raw: dict[str, Any] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in FINGERS}
        return parse_config(raw | {"guard": self.guard, "loop": self.loop}, where="test", sim=True)

    def _watch(self, decision: Decision) -> None:
        self.ticks += 1
        if decision.output.text is not None:
            self.messages.append(decision.output.text)
        if not self.phases or decision.phase is not self.phases[-1]:
            self.phases.append(decision.phase)
        if self.watched:
            self._watch_grip()

    def _watch_grip(self) -> None:
        truth, width_mm = self.truth, self.width_mm
        if truth.dropped is not None or any(what == "release" for _, what, _ in self.gripper.commands):
            return
        if truth.force_n < self.tightest_n - 0.01 or (truth.in_contact and width_mm > self.narrowest_mm + 0.01):
            self.loosened = self.loosened or f"{truth.force_n:.1f} N, {width_mm:.1f} mm at {self.now_s:.3f}: {truth}"
        self.tightest_n, self.narrowest_mm = max(self.tightest_n, truth.force_n), min(self.narrowest_mm, width_mm)

    @property
    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    @property
    def truth(self) -> WorldTruth:
        return self.world.truth(self.now_s)

    @property
    def phase(self) -> Phase:
        return self.service.phase

    @property
    def width_mm(self) -> float:
        return self.world.gripper_state(self.now_s).width_mm

    def steady(self) -> bool:
        """Whether the object is held at rest, with the commanded force."""
        return self.service.ready_to_lift

    @property
    def summary(self) -> str:
        """Phase, messages and truth, for the report of a failing test."""
        service = self.service
        return f"{self.phase} at {self.now_s:.2f} s: {service.waiting_for} {service.event_log.lines[-6:]} {self.truth}"

    async def until(self, reached: Callable[[], bool], within_s: float = 10.0) -> None:
        """Wait on the virtual clock; fail with a summary if it takes too long."""
        deadline_s = self.now_s + within_s
        while not reached():
            assert self.now_s < deadline_s, self.summary
            await asyncio.sleep(0.01)

    async def faulted(self, code: FaultCode, within_s: float = 10.0) -> Fault:
        """Wait for a fault and return it; fail if it has another code."""
        await self.until(lambda: self.phase is Phase.FAULT, within_s)
        fault = self.service.state.fault
        assert fault is not None
        assert fault.code is code, fault
        return fault

    async def ready(self) -> None:
        await self.until(lambda: not self.service.waiting_for)

    async def submit(self, request: DaemonRequest) -> str:
        """Submit a request; return the message of its response."""
        return str((await self.handlers.submit(request))["message"])

    async def grasp(self) -> None:
        await self.ready()
        await self.submit(GraspRequest())
        await self.until(lambda: self.phase is not Phase.CLOSING)
        await self.until(self.steady)

    async def lift(self) -> None:
        await self.submit(LiftRequest())
        await self.until(lambda: self.phase is not Phase.LIFTING, 20.0)

    async def lower(self) -> None:
        await self.submit(LowerRequest())
        await self.until(lambda: self.phase is not Phase.LOWERING, 20.0)

    async def release(self) -> None:
        await self.submit(ReleaseRequest(confirm=True))
        await self.until(lambda: self.phase is Phase.IDLE)


@asynccontextmanager
async def running(cell: Cell) -> AsyncIterator[Cell]:
    """The service runs while the body does; what it raises is raised here, and it leaves no task behind."""
    if cell.fresh:
        drawn = scenario(cell.object_name, cell.seed)
        left, right = replace(drawn.left, fps=cell.fps), replace(drawn.right, fps=cell.fps)
        cell.world.place(replace(drawn, left=left, right=right), cell.now_s)
    before = asyncio.all_tasks()
    task = asyncio.create_task(cell.service.run(), name="service")
    try:
        yield cell
        assert not task.done(), task
        assert cell.loosened is None, cell.loosened
        assert cell.service.observer_errors == cell.observer_errors, cell.summary
    finally:
        task.cancel()
        (end,) = await asyncio.gather(task, return_exceptions=True)
        left = {one for one in asyncio.all_tasks() - before if not one.done()}
        assert not left, left
        assert all(worker.closed for worker in cell.workers.values())
        if not isinstance(end, asyncio.CancelledError):
            raise end


def play(cell: Cell, scene: Callable[[Cell], Coroutine[Any, Any, None]]) -> Cell:
    """Run one scene with the service running, on a virtual clock of its own."""

    async def main() -> None:
        async with running(cell):
            await scene(cell)

    run_virtual(main())
    return cell


def on_cell(*args: Any, make: Callable[..., Cell] = Cell, **settings: Any) -> Callable[[Scene], Callable[..., None]]:
    """Return a decorator that makes an async function with a `cell` a test: a scene on a new `make(...)`."""

    def decorate(scene: Scene) -> Callable[..., None]:
        @wraps(scene)
        def test(**values: Any) -> None:
            play(make(*args, **settings), partial(scene, **values))

        test.__signature__ = inspect.Signature(list(inspect.signature(scene).parameters.values())[1:])  # type: ignore[attr-defined]
        return test

    return decorate
