"""A whole cell on the virtual clock: the real service, law, fakes and world; the pictures alone are stood in for.

The sensor delivers on the fake's own schedule, with its latency, losses, repetitions and faults, but paints one flat
colour: a number under which the truth at the moment of exposure is kept. The perceiver looks the truth up and adds
seeded noise. So a lift of eight seconds takes a fraction of one.
"""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator, Callable, Coroutine
from contextlib import asynccontextmanager
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.config import Config, parse_config
from slipguard.daemon.calibration import NoContact
from slipguard.daemon.controls import Controls
from slipguard.daemon.service import FINGERS, Decision, Law, Service
from slipguard.daemon.virtual_time import run_virtual
from slipguard.daemon.worker import StatedLatencyWorker, ThreadWorker, Worker
from slipguard.devices import DriverContext, Frame
from slipguard.grasp.guard import tick
from slipguard.grasp.state import Phase
from slipguard.perception.estimate import Estimate
from slipguard.sim import objects
from slipguard.sim.cell import Truth
from slipguard.sim.scenario import scenario
from slipguard.sim.world import World, WorldSettings
from slipguard_drivers.digit.draw_worker import Shot
from slipguard_drivers.digit.fake import FakeSensor
from slipguard_drivers.digit.stream import SHAPE
from slipguard_drivers.robotiq.fake import FakeGripper
from slipguard_drivers.ur5.fake import FakeArm

SIGMA_DEG = 0.4
NOISE_MM = 0.03
STABLE_FRAMES = 5
SWING_DEG_S = 25.0
ALPHA, BETA = 0.5, 0.15  # turn and rate gain of the tracker's filter
Image = NDArray[np.uint8]


@dataclass
class Pictures:
    """Truths by the number that a flat picture shows."""

    world: World
    count: int = 0
    shown: dict[int, Truth] = field(default_factory=dict)
    flickers: bool = False

    async def start(self) -> None:
        """Nothing to get ready."""

    def paint(self, shot: Shot, done: Callable[[Image], None]) -> bool:
        self.count += 1
        self.shown[self.count] = self.world.truth(asyncio.get_running_loop().time())
        self.shown.pop(self.count - 100, None)
        row = np.full(SHAPE[1:], 60 * (self.count % 2) if self.flickers else 0, np.uint8)
        row[0] = tuple(self.count.to_bytes(3, "little"))
        done(np.broadcast_to(row, SHAPE))
        return True

    def truth(self, image: Image) -> Truth:
        return self.shown[int.from_bytes(image[0, 0].tobytes(), "little")]

    def stop(self) -> None:
        """Nothing to let go of."""


class FlatSensor(FakeSensor):
    """The fake sensor with pictures that cost nothing."""

    def __init__(self, context: DriverContext) -> None:
        super().__init__(FakeSensor.Settings(draw="inline"), context)
        self.pictures = Pictures(self._world)
        self._painter = self.pictures
        self.opened = 0

    async def open(self) -> None:
        self.opened += 1
        await super().open()


class Oracle:
    """A perceiver that knows the truth, with the noise, the reference and the declining of the real one.

    always_touched: it sees contact where there is none. swings_since_s: it sees the object turn, though it rests.
    """

    def __init__(self, pictures: Pictures, sign: float, rng: np.random.Generator, blind: str | None) -> None:
        self.pictures, self.sign, self.rng, self.blind = pictures, sign, rng, blind
        self.always_touched = False
        self.swings_since_s: float | None = None
        self.sequence = 0
        self.reset_reference()

    def reset_reference(self) -> None:
        self.stable = 0
        self.reference: tuple[float, float] | None = None
        self.track = (0.0, 0.0)
        self.tracked_s = 0.0

    def process(self, frame: Frame) -> Estimate:
        truth, now_s = self.pictures.truth(frame.image), frame.captured_at_s
        self.sequence = frame.sequence
        touched = truth.in_contact or self.always_touched
        plain = Estimate(frame.sequence, now_s, now_s, touched, 4000 * touched, "oracle")
        if not touched:
            self.stable = 0
            return replace(plain, skipped="no contact", declined="no contact")
        turn_deg = self.sign * truth.turn_deg + self.rng.normal(0.0, SIGMA_DEG)
        if self.swings_since_s is not None:
            turn_deg += self.sign * SWING_DEG_S * (now_s - self.swings_since_s)
        slide_mm = truth.slide_mm + self.rng.normal(0.0, NOISE_MM)
        self.stable += 1
        if self.reference is None:
            if self.stable < STABLE_FRAMES:
                return replace(plain, declined="no reference yet")
            self.reference, self.tracked_s = (turn_deg, slide_mm), now_s
        shift_mm = (0.0, self.reference[1] - slide_mm)
        if self.blind is not None:
            return replace(plain, shift_mm=shift_mm, declined=self.blind)
        turn_deg -= self.reference[0]
        passed_s = max(now_s - self.tracked_s, 1e-3)
        value, rate = self.track[0] + self.track[1] * passed_s, self.track[1]
        self.track = (value + ALPHA * (turn_deg - value), rate + BETA * (turn_deg - value) / passed_s)
        self.tracked_s = now_s
        return replace(
            plain, angle_deg=turn_deg, sigma_deg=SIGMA_DEG, orientation_deg=0.0,
            rate_deg_s=self.track[1], shift_mm=shift_mm,
        )  # fmt: skip


class LoggedGripper(FakeGripper):
    """The fake gripper, and what it was told and when. A `failure` is raised by the next commands instead."""

    def __init__(self, context: DriverContext) -> None:
        super().__init__(FakeGripper.Settings(), context)
        self.told: list[tuple[float, str, float]] = []
        self.failures: list[Exception] = []

    async def hold(self, force_n: float) -> float:
        self._note("hold", force_n)
        return await super().hold(force_n)

    async def move(self, width_mm: float, force_n: float) -> float:
        self._note("move", width_mm)
        return await super().move(width_mm, force_n)

    async def release(self, width_mm: float) -> None:
        self._note("release", width_mm)
        await super().release(width_mm)

    def _note(self, what: str, value: float) -> None:
        self.told.append((asyncio.get_running_loop().time(), what, value))
        if self.failures:
            raise self.failures.pop(0)


class LoggedArm(FakeArm):
    """The fake arm, and what it was told and when."""

    def __init__(self, context: DriverContext) -> None:
        super().__init__(FakeArm.Settings(), context)
        self.told: list[tuple[float, str, float]] = []

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        self.told.append((asyncio.get_running_loop().time(), "lift", height_mm))
        return await super().lift(height_mm, speed_mm_s)

    async def stop(self) -> None:
        self.told.append((asyncio.get_running_loop().time(), "stop", 0.0))
        await super().stop()


class Memory:
    """A store of no-contact images that forgets with the process."""

    def __init__(self, *serials: str) -> None:
        blank = np.zeros(SHAPE, np.uint8)
        self.kept = {serial: NoContact(blank, (2.0, 2.0, 2.0), 30) for serial in serials}

    def load_no_contact(self, serial: str) -> NoContact | None:
        return self.kept.get(serial)

    def save_no_contact(self, serial: str, taken: NoContact) -> None:
        self.kept[serial] = taken


class Shelf(StatedLatencyWorker):
    """A worker of stated latency that knows whether it was closed."""

    closed = False

    def close(self) -> None:
        self.closed = True


@dataclass
class Cell:
    """One service on a world of its own (or on the one it is given, as after a restart).

    guard, loop: sections of the configuration. blind: finger -> why it declines every turn. threads: real workers
    instead of a stated latency, for the real clock. watched: the grip is compared with the truth at every tick.
    """

    object_name: str = "wrench"
    seed: int = 0
    guard: dict[str, object] = field(default_factory=dict)
    loop: dict[str, object] = field(default_factory=dict)
    blind: dict[str, str] = field(default_factory=dict)
    law: Law = tick
    latency_s: float = 0.006
    threads: bool = False
    fps: float = 60.0
    watched: bool = True
    world: World | None = None
    calibrated: bool = True
    says: list[str] = field(default_factory=list)
    phases: list[Phase] = field(default_factory=list)
    ticks: int = 0
    loosened: str | None = None
    """The first moment at which the grip got weaker or wider though nobody had asked to release."""
    tightest_n: float = 0.0
    narrowest_mm: float = 1e9

    def __post_init__(self) -> None:
        self.fresh = self.world is None
        start_mm = objects.get(self.object_name).width_mm + 20.0
        settings = WorldSettings(step_s=2e-3, start_width_mm=start_mm)
        self.world = world = self.world or World(settings, seed=self.seed)
        rng = np.random.default_rng([self.seed, 7])
        self.sensors = {name: FlatSensor(DriverContext(name, world)) for name in FINGERS}
        self.gripper = LoggedGripper(DriverContext("gripper", world))
        self.arm = LoggedArm(DriverContext("arm", world))
        self.workers: dict[str, Shelf] = {}
        self.perceivers: dict[str, list[Oracle]] = {name: [] for name in FINGERS}
        self.store = Memory("SIM-L", "SIM-R") if self.calibrated else Memory()

        def make_worker(name: str) -> Worker:
            if self.threads:
                return ThreadWorker(name)
            self.workers[name] = Shelf(self.latency_s)
            return self.workers[name]

        def maker(name: str) -> Callable[[str], Oracle]:
            def make(serial: str) -> Oracle:
                sign = 1.0 if name == "left" else -1.0
                made = Oracle(self.sensors[name].pictures, sign, rng, self.blind.get(name))
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
            law=self.law,
        )
        self.controls = Controls(self.service)
        self.service.observers.append(self._watch)

    def _config(self) -> Config:
        raw: dict[str, Any] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in FINGERS}
        return parse_config(raw | {"guard": self.guard, "loop": self.loop}, where="test", sim=True)

    def _watch(self, decision: Decision) -> None:
        self.ticks += 1
        if decision.command.say is not None:
            self.says.append(decision.command.say)
        if not self.phases or decision.phase is not self.phases[-1]:
            self.phases.append(decision.phase)
        if self.watched:
            self._watch_grip()

    def _watch_grip(self) -> None:
        truth, width_mm = self.truth, self.width_mm
        if truth.dropped is not None or any(what == "release" for _, what, _ in self.gripper.told):
            return
        if truth.force_n < self.tightest_n - 0.01 or (truth.in_contact and width_mm > self.narrowest_mm + 0.01):
            self.loosened = self.loosened or f"{truth.force_n:.1f} N, {width_mm:.1f} mm at {self.now_s:.3f}: {truth}"
        self.tightest_n, self.narrowest_mm = max(self.tightest_n, truth.force_n), min(self.narrowest_mm, width_mm)

    # What is so.

    @property
    def now_s(self) -> float:
        return asyncio.get_running_loop().time()

    @property
    def truth(self) -> Truth:
        assert self.world is not None
        return self.world.truth(self.now_s)

    @property
    def phase(self) -> Phase:
        return self.service.phase

    @property
    def width_mm(self) -> float:
        assert self.world is not None
        return self.world.gripper_state(self.now_s).width_mm

    def steady(self) -> bool:
        """Held, calm, and the grip as firm as it was commanded."""
        return self.service.firm

    @property
    def where(self) -> str:
        """How things stand, for a failing test."""
        service = self.service
        return f"{self.phase} at {self.now_s:.2f} s: {service.waiting_for} {service.said[-6:]} {self.truth}"

    # What is done.

    async def until(self, reached: Callable[[], bool], within_s: float = 10.0) -> None:
        """Wait on the virtual clock; says where things stood if it takes too long."""
        deadline_s = self.now_s + within_s
        while not reached():
            assert self.now_s < deadline_s, self.where
            await asyncio.sleep(0.01)

    async def ready(self) -> None:
        await self.until(lambda: not self.service.waiting_for)

    async def grasp(self) -> None:
        await self.ready()
        await self.controls.grasp()
        await self.until(lambda: self.phase is not Phase.CLOSING)
        await self.until(self.steady)

    async def lift(self) -> None:
        await self.controls.lift()
        await self.until(lambda: self.phase is not Phase.LIFTING, 20.0)

    async def lower(self) -> None:
        await self.controls.lower()
        await self.until(lambda: self.phase is not Phase.LOWERING, 20.0)

    async def release(self) -> None:
        await self.controls.release()
        await self.until(lambda: self.phase is Phase.IDLE)


@asynccontextmanager
async def running(cell: Cell) -> AsyncIterator[Cell]:
    """The service runs while the body does; what it raises is raised here, and it leaves no task behind."""
    assert cell.world is not None
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
