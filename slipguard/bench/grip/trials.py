"""Trials of the grip controllers: every combination of object, first grip, latency, gel and frame rate.

A trial is a function of its number and seed. Grip shares refer to the true force: only the simulated world knows how
much it differs from the commanded force.
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
"""Test objects whose rotation is visible; the ring has neither axis nor texture."""
SHARES = (0.97, 0.90, 0.75, 0.50)
"""First grip relative to the needed force."""
LATENCIES_S = (0.060, 0.100, 0.150, 0.250)
"""From exposure to the start of the motor."""
FRAME_RATES = (60.0, 30.0)
NEEDED_MIN_N, NEEDED_MAX_SHARE = 45.0, 0.6
"""Range of the needed force; the upper limit is relative to `force_max_n`. A 2F-85 cannot grip below 20 N."""
TIGHT_SHARES = (0.75, 0.95)
"""Needed force relative to the force that the limit really allows: one step is not enough."""
FRAGILE_MAX_N = 57.0
"""`force_max_n` of a fragile object."""
FRICTION = (0.4, 1.0)
PERCEIVING_S = 0.006
CAMERA_SHARE = 0.4
"""Camera's share of the latency without perception; the rest belongs to the gripper's line and motor."""
TRANSACTION_MAX_S = 0.016
ROOM_MM = 2.0
"""The jaws start this much wider than the object."""
SPEED_MM_S = (30.0, 120.0)
"""Speeds of another program's lift, without slipguard's slow start."""
Event = Literal["support gone", "lifted"]
Block = Literal["matrix", "high need", "fragile"]
BLOCK_NUMBERS: dict[Block, int] = {"matrix": 0, "high need": 6_000, "fragile": 7_000}
"""First trial number of each block."""


@dataclass(frozen=True, slots=True)
class GripTrial:
    """One grasp that is too weak. item: with a mass that needs `needed_n`. first_n: commanded force per finger.

    event: the support is removed while the arm stands, or the arm lifts the object off its table.
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
        return force_limit_n(self.block)

    @property
    def name(self) -> str:
        gel = "soft" if self.soft else "stiff"
        return f"trial {self.number}: {self.item.name}, {self.share:g} of {self.needed_n:.0f} N, {gel} gel"


def force_limit_n(block: Block) -> float:
    return FRAGILE_MAX_N if block == "fragile" else GuardParams().force_max_n


def needed_range_n(block: Block, gain: float) -> tuple[float, float]:
    """Return the range of the needed true force per finger for a gripper of this gain."""
    if block == "matrix":
        return NEEDED_MIN_N, NEEDED_MAX_SHARE * force_limit_n(block)
    model = GripperDynamics()
    within = force_range(force_limit_n(block), (model.force_min_n, model.force_max_n))
    assert within is not None, "the force limit is below the gripper's minimum force"
    low, high = TIGHT_SHARES
    return low * gain * within.high_n, high * gain * within.high_n


def trials(count: int | None, rendered: int, seed: int = 0, block: Block = "matrix") -> list[GripTrial]:
    """Return the matrix, or `count` trials spread evenly over every axis; `rendered` of them with rendered frames.

    Equal seeds give equal trials; a smaller count gives a subset of a larger one. block: selects the needed force and
    the force limit.
    """
    cells = list(product(TEST_OBJECTS, SHARES, LATENCIES_S, (False, True), FRAME_RATES))
    order = np.random.default_rng(seed).permutation(len(cells))
    chosen = _balanced([cells[index] for index in order], len(cells) if count is None else min(count, len(cells)))
    drawn = [draw(BLOCK_NUMBERS[block] + k, *cell, seed=seed, block=block) for k, cell in enumerate(chosen)]
    return [replace(trial, rendered=k < rendered) for k, trial in enumerate(drawn)]


Cell = tuple[str, float, float, bool, float]


def _balanced(cells: list[Cell], count: int) -> list[Cell]:
    """Return `count` cells in which every value of every axis appears equally often, as far as possible."""
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
    """Return one trial; everything that the matrix does not fix is drawn at random."""
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
    """Return the object with this friction and the mass and inertia for which it needs this force, to 1e-9."""
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
    """Return a gripper with its share of the latency: two transactions, then the motor's dead time."""
    rest_s = (1.0 - CAMERA_SHARE) * (latency_s - PERCEIVING_S)
    transaction_s = min(TRANSACTION_MAX_S, rest_s / 4.0)
    return GripperDynamics(
        transaction_s=transaction_s,
        dead_time_s=rest_s - 2.0 * transaction_s,
        ramp_n_s=float(np.exp(rng.uniform(np.log(64.0), np.log(480.0)))),
        gain=float(rng.uniform(0.9, 1.1)),
    )


def _delivery(rng: np.random.Generator, fps: float, latency_s: float) -> FrameDelivery:
    """Return a camera with its share of the latency, in a light that differs from that of the background image."""
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
