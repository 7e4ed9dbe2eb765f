"""The law in closed loop with the simulated world; the network is replaced by an error model of its estimates."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np

from slipguard.grasp.fuse import fuse
from slipguard.grasp.guard import Guard, tick
from slipguard.grasp.messages import ArmLift, Command, FingerHealth, Request, RequestKind, Seen
from slipguard.grasp.params import GuardParams
from slipguard.grasp.state import Phase
from slipguard.perception.estimate import Estimate
from slipguard.sim.friction import Gel, needed_force_n
from slipguard.sim.objects import SimObject
from slipguard.sim.scenario import Scenario
from slipguard.sim.world import World

TICK_S = 0.01
FRAME_S = 1 / 60
SIGMA_DEG = 0.5
ALPHA, BETA = 0.5, 0.15  # turn and rate gain of the tracker's filter
PERCEIVING_S = 0.005
GRIPPER_TRIP_S = 0.004


def bar(needed_n: float, gel: Gel, offset_mm: float = 100.0, friction: float = 0.8) -> SimObject:
    """A bar held at one end whose mass makes it need this force."""

    def of(mass_kg: float) -> SimObject:
        return SimObject(
            name="bar", split="test", height_mm=lambda u, v: np.zeros_like(u), mass_kg=mass_kg, com_offset_mm=offset_mm,
            inertia_kg_m2=mass_kg * (offset_mm * 1e-3) ** 2 / 3, friction=friction, press_mm=1.0,
        )  # fmt: skip

    low, high = 1e-3, 20.0
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed_force_n(of(middle), gel) < needed_n else (low, middle)
    return of(low)


@dataclass
class Finger:
    """One camera with an error model instead of pictures."""

    name: str
    rng: np.random.Generator
    sign: float
    blind: bool = False
    sequence: int = 0
    stable: int = 0
    reference_deg: float | None = None
    reference_mm: float = 0.0
    filtered: tuple[float, float] | None = None

    def reset(self) -> None:
        self.reference_deg, self.filtered, self.stable = None, None, 0

    def measure(self, world: World, captured_s: float) -> Estimate:
        truth = world.truth(captured_s)
        self.sequence += 1
        plain = Estimate(self.sequence, captured_s, captured_s, truth.in_contact, 4000 * truth.in_contact, "model")
        if not truth.in_contact:
            self.reset()
            return plain
        angle = self.sign * truth.turn_deg + self.rng.normal(0.0, SIGMA_DEG)
        slide = truth.slide_mm + self.rng.normal(0.0, 0.05)
        self.stable += 1
        if self.stable < 5:
            return plain
        if self.reference_deg is None:
            self.reference_deg, self.reference_mm = angle, slide
        shift = (0.0, -(slide - self.reference_mm))
        if self.blind:
            return replace(plain, shift_mm=shift, declined="round contact")
        turn = angle - self.reference_deg
        if self.filtered is None:
            self.filtered = (turn, 0.0)
        value, rate = self.filtered
        value += rate * FRAME_S
        residual = turn - value
        self.filtered = (value + ALPHA * residual, rate + BETA * residual / FRAME_S)
        return replace(
            plain, angle_deg=turn, sigma_deg=SIGMA_DEG, rate_deg_s=self.filtered[1], shift_mm=shift, orientation_deg=0.0
        )


@dataclass
class Run:
    """One simulated run, step by step."""

    world: World
    params: GuardParams
    seed: int = 0
    blind: tuple[str, ...] = ()
    guard: Guard = field(default_factory=Guard)
    now_s: float = 100.0
    commands: list[tuple[float, Command]] = field(default_factory=list)
    says: list[str] = field(default_factory=list)
    peak_deg: float = 0.0

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        self.fingers = {
            name: Finger(name, rng, sign, blind=name in self.blind) for name, sign in (("left", 1.0), ("right", -1.0))
        }
        self.estimates: dict[str, Estimate | None] = {"left": None, "right": None}
        self.queue: list[tuple[float, int, Callable[[], None]]] = []
        self.order = 0
        self.frame_s = {"left": self.now_s, "right": self.now_s + 0.007}
        self.reset_s = -math.inf

    def later(self, when_s: float, action: Callable[[], None]) -> None:
        self.order += 1
        heapq.heappush(self.queue, (when_s, self.order, action))

    def capture(self) -> None:
        for name, finger in self.fingers.items():
            while self.frame_s[name] <= self.now_s:
                captured_s = self.frame_s[name]
                estimate = finger.measure(self.world, captured_s)
                self.frame_s[name] += FRAME_S
                if captured_s >= self.reset_s:
                    delay_s = self.world.camera(name).latency_s + PERCEIVING_S
                    self.later(captured_s + delay_s, lambda n=name, e=estimate: self.estimates.__setitem__(n, e))

    def tick(self, request: Request | None = None) -> Command:
        self.now_s += TICK_S
        self.capture()
        while self.queue and self.queue[0][0] <= self.now_s:
            _, _, action = heapq.heappop(self.queue)
            action()
        ages = {n: FingerHealth(age_s=self.now_s - e.captured_at_s if e else 0.0) for n, e in self.estimates.items()}
        seen = Seen(
            now_s=self.now_s,
            fused=fuse(self.estimates["left"], self.estimates["right"]),
            left=ages["left"],
            right=ages["right"],
            gripper=self.world.gripper_state(self.now_s),
            arm=self.world.arm_state(self.now_s),
            request=request or Request(),
        )
        self.guard, command = tick(self.guard, seen, self.params)
        self.obey(command)
        truth = self.world.truth(self.now_s)
        self.peak_deg = max(self.peak_deg, abs(truth.turn_deg))
        return command

    def obey(self, command: Command) -> None:
        if command != Command(fault=command.fault):
            self.commands.append((self.now_s, command))
        if command.say:
            self.says.append(f"{self.now_s:.2f} {command.say}")
        if command.new_reference:
            self.reset_s = self.now_s
            for name, finger in self.fingers.items():
                finger.reset()
                self.estimates[name] = None
        at_s = self.now_s + GRIPPER_TRIP_S
        if command.hold_force_n is not None:
            self.later(at_s, lambda n=command.hold_force_n: self.world.command_hold(self.now_s, n))
        if command.release_width_mm is not None:
            self.later(at_s, lambda w=command.release_width_mm: self.world.command_release(self.now_s, w))
        if command.arm == "stop":
            self.world.command_stop(self.now_s)
        elif isinstance(command.arm, ArmLift):
            self.world.command_lift(self.now_s, command.arm.height_mm, command.arm.speed_mm_s)

    def until(self, done: Callable[[], bool], limit_s: float) -> bool:
        end_s = self.now_s + limit_s
        while self.now_s < end_s:
            self.tick()
            if done():
                return True
        return False

    @property
    def phase(self) -> Phase:
        return self.guard.law.phase


def placed(item: SimObject, scenario: Scenario, params: GuardParams, seed: int = 0, **kwargs: object) -> Run:
    """A run with the object between the open jaws."""
    world = World(seed=seed, lookup=lambda name: item)
    run = Run(world, params, seed=seed, **kwargs)  # type: ignore[arg-type]
    world.place(replace(scenario, object_name=item.name), run.now_s)
    return run


def grasp_and_lift(run: Run, *, guarded: bool = True, hold_s: float = 1.0) -> Run:
    """Grasp, lift, hold for a while."""
    if not guarded:
        run.tick(Request(RequestKind.GUARD_OFF))
    run.tick(Request(RequestKind.GRASP))
    ready = lambda: run.phase is Phase.HOLDING and not run.world.gripper_state(run.now_s).moving  # noqa: E731
    run.until(lambda: run.phase not in (Phase.CLOSING, Phase.REFERENCE), 8.0)
    run.until(ready, 4.0)
    for _ in range(10):
        run.tick()
    run.tick(Request(RequestKind.LIFT))
    run.until(lambda: run.phase in (Phase.HOLDING, Phase.FAULT), 15.0)
    run.until(lambda: False, hold_s)
    return run
