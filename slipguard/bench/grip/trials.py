"""What the grip law is tried on: every combination of first grip, latency, gel and frame rate, on every object.

A trial is drawn from its number and seed alone. Grip shares refer to the true force: how much stronger or weaker the
gripper is than it says is known to the world only.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import Literal

import numpy as np

from slipguard.control.force_limits import force_range
from slipguard.control.params import GuardParams
from slipguard.sim.catalogue import find_object
from slipguard.sim.friction import SoftPad, needed_force_n
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import FrameDelivery, Scenario
from slipguard.sim.sim_object import SimObject

TEST_OBJECTS = ("bar", "wedge", "wrench", "knife_edge", "key", "screwdriver", "cap", "ball", "hook")
"""All test objects whose turn can be seen; the ring has neither axis nor texture and is gripped blindly."""
SHARES = (0.97, 0.90, 0.75, 0.50)
"""First grip over the force needed."""
LATENCIES_S = (0.060, 0.100, 0.150, 0.250)
"""From exposure to the moment the motor begins to tighten."""
FRAME_RATES = (60.0, 30.0)
NEEDED_MIN_N, NEEDED_MAX_SHARE = 45.0, 0.6
"""The force needed lies between this and this share of `force_max_n`: a 2F-85 cannot grip under 20 N."""
TIGHT_SHARES = (0.75, 0.95)
"""Beside the matrix: the force needed over what the budget really applies, so that one step is not enough."""
FRAGILE_MAX_N = 57.0
"""`force_max_n` of something that breaks."""
FRICTION = (0.4, 1.0)
PERCEIVING_S = 0.006
CAMERA_SHARE = 0.4
"""Of what is left of the latency; the rest is the gripper's line and motor."""
TRANSACTION_MAX_S = 0.016
ROOM_MM = 2.0
"""The jaws begin this much wider than the object."""
SPEED_MM_S = (30.0, 120.0)
"""Another program's lift, without slipguard's slow beginning."""
Event = Literal["support gone", "lifted"]
Block = Literal["matrix", "high need", "fragile"]
BLOCK_NUMBERS: dict[Block, int] = {"matrix": 0, "high need": 6_000, "fragile": 7_000}
"""Trials of a block are numbered from here on."""


@dataclass(frozen=True, slots=True)
class GripTrial:
    """One grasp that is too weak. item: mass scaled to need `needed_n`; first_n: commanded, per finger.

    event: the support goes away at once while the arm stands, or the arm lifts the object off its table.
    """

    number: int
    item: SimObject
    share: float
    latency_s: float
    soft: bool
    fps: float
    needed_n: float
    first_n: float
    scenario: Scenario
    event: Event = "lifted"
    lift_speed_mm_s: float = 50.0
    rendered: bool = False
    block: Block = "matrix"

    @property
    def force_max_n(self) -> float:
        """The budget, as commanded."""
        return force_limit_n(self.block)

    @property
    def name(self) -> str:
        """For messages."""
        gel = "soft" if self.soft else "stiff"
        return f"trial {self.number}: {self.item.name}, {self.share:g} of {self.needed_n:.0f} N, {gel} gel"


def force_limit_n(block: Block) -> float:
    """`force_max_n` in a block."""
    return FRAGILE_MAX_N if block == "fragile" else GuardParams().force_max_n


def needed_range_n(block: Block, gain: float) -> tuple[float, float]:
    """Between which true forces per finger a trial's need lies, with a gripper of this gain."""
    if block == "matrix":
        return NEEDED_MIN_N, NEEDED_MAX_SHARE * force_limit_n(block)
    model = GripperDynamics()
    within = force_range(force_limit_n(block), (model.force_min_n, model.force_max_n))
    assert within is not None, "a budget below the gripper's weakest grip"
    low, high = TIGHT_SHARES
    return low * gain * within.high_n, high * gain * within.high_n


def trials(count: int | None, rendered: int, seed: int = 0, block: Block = "matrix") -> list[GripTrial]:
    """The matrix, or `count` of it spread evenly over every axis; `rendered` of them spread evenly, too.

    The same seed gives the same trials; a smaller count gives some of those of a larger one. block: other needs and
    another budget, everything else alike.
    """
    cells = list(product(TEST_OBJECTS, SHARES, LATENCIES_S, (False, True), FRAME_RATES))
    order = np.random.default_rng(seed).permutation(len(cells))
    chosen = _balanced([cells[index] for index in order], len(cells) if count is None else min(count, len(cells)))
    drawn = [draw(BLOCK_NUMBERS[block] + k, *cell, seed=seed, block=block) for k, cell in enumerate(chosen)]
    return [replace(trial, rendered=k < rendered) for k, trial in enumerate(drawn)]


Cell = tuple[str, float, float, bool, float]


def _balanced(cells: list[Cell], count: int) -> list[Cell]:
    """The first `count` cells in an order in which every value of every axis comes equally often, as far as it can."""
    seen: dict[tuple[int, object], int] = {}
    left = list(cells)
    chosen: list[Cell] = []
    while len(chosen) < count:
        best = min(range(len(left)), key=lambda index: sum(seen.get((k, v), 0) for k, v in enumerate(left[index])))
        cell = left.pop(best)
        chosen.append(cell)
        for axis in enumerate(cell):
            seen[axis] = seen.get(axis, 0) + 1
    return chosen


def draw(
    number: int,
    name: str,
    share: float,
    latency_s: float,
    soft: bool,
    fps: float,
    *,
    seed: int = 0,
    block: Block = "matrix",
) -> GripTrial:
    """One trial: what the matrix does not fix is drawn."""
    rng = np.random.default_rng([seed, number, 5])
    friction = float(rng.uniform(*FRICTION))
    viscous = float(rng.uniform(0.005, 0.02))
    torsion = float(np.exp(rng.uniform(np.log(0.1), np.log(0.5))))
    gel = SoftPad(torsion_n_m_rad=50.0, relaxation_s=0.005, viscous_n_m_s=viscous)
    if soft:
        relaxation_s = float(rng.uniform(0.01, 0.03))
        gel = SoftPad(torsion_n_m_rad=torsion, stiffening=3.0, relaxation_s=relaxation_s, viscous_n_m_s=viscous)
    gripper = _gripper(rng, latency_s)
    lowest_n, highest_n = needed_range_n(block, gripper.gain)
    wanted_n = float(rng.uniform(lowest_n, highest_n))
    first_n = gripper.quantized_force_n(share * wanted_n / gripper.gain)
    if first_n * gripper.gain / share > highest_n:
        first_n -= gripper.force_step_n
    needed_n = first_n * gripper.gain / share
    item = scaled(find_object(name), needed_n, friction, gel)
    x_mm, y_mm = (float(v) for v in rng.uniform(-2.0, 2.0, 2))
    scenario = Scenario(
        object_name=name,
        seed=number,
        x_mm=x_mm,
        y_mm=y_mm,
        angle_deg=float(rng.uniform(-90.0, 90.0)),
        lever_sign=int(rng.choice((-1, 1))),
        gel=gel,
        gripper=gripper,
        left=_delivery(rng, fps, latency_s),
        right=_delivery(rng, fps, latency_s),
    )
    speed = float(np.exp(rng.uniform(*np.log(SPEED_MM_S))))
    return GripTrial(
        number, item, share, latency_s, soft, fps, needed_n, first_n, scenario, lift_speed_mm_s=speed, block=block
    )


def scaled(item: SimObject, needed_n: float, friction: float, gel: SoftPad) -> SimObject:
    """The object with another friction and a mass (and inertia) that makes it need this force; to 1e-9.

    A lever so short that the load alone needs the force would only slide: it is kept, the mass decides.
    """
    density = item.inertia_kg_m2 / item.mass_kg

    def of(mass_kg: float) -> SimObject:
        return replace(item, mass_kg=mass_kg, inertia_kg_m2=density * mass_kg, friction=friction)

    low, high = 0.0, 1.0
    while needed_force_n(of(high), gel) < needed_n:
        high *= 2.0
    while high - low > 1e-9 * high:
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed_force_n(of(middle), gel) < needed_n else (low, middle)
    return of(high)


def _gripper(rng: np.random.Generator, latency_s: float) -> GripperDynamics:
    """A gripper that takes its share of the latency: two transactions, then the motor's dead time."""
    rest_s = (1.0 - CAMERA_SHARE) * (latency_s - PERCEIVING_S)
    transaction_s = min(TRANSACTION_MAX_S, rest_s / 4.0)
    return GripperDynamics(
        transaction_s=transaction_s,
        dead_time_s=rest_s - 2.0 * transaction_s,
        ramp_n_s=float(np.exp(rng.uniform(np.log(64.0), np.log(480.0)))),
        gain=float(rng.uniform(0.9, 1.1)),
    )


def _delivery(rng: np.random.Generator, fps: float, latency_s: float) -> FrameDelivery:
    """A camera that takes its share of the latency, in a light that is not quite that of the no-contact image."""
    drift = rng.uniform(-5.0, 5.0, 3)
    return FrameDelivery(
        fps=fps,
        latency_s=CAMERA_SHARE * (latency_s - PERCEIVING_S),
        jitter_s=float(rng.uniform(0.001, 0.003)),
        drop_probability=float(rng.uniform(0.001, 0.01)),
        duplicate_probability=0.0,
        light_drift_bgr=(float(drift[0]), float(drift[1]), float(drift[2])),
        noise_seed=int(rng.integers(2**31)),
    )
