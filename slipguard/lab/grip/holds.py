"""Stable holds: what turns the gel but not the object. Whatever the law tightens here it tightens for nothing.

Each hold begins with a lift, during which the gel winds up under the weight for the first time. Then the arm starts and
stops, shakes, somebody brushes past, and the light drifts, for minutes. The grip is firm: it needs no more.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from slipguard.grasp.messages import Request, RequestKind
from slipguard.grasp.params import GuardParams
from slipguard.grasp.state import Phase
from slipguard.lab.grip.controllers import Law
from slipguard.lab.grip.loop import FINGERS, Loop
from slipguard.lab.grip.matrix import PERCEIVING_S, Trial, trials
from slipguard.lab.grip.sight import Drift
from slipguard.lab.grip.stage import chances, grip, model_sight, world_of
from slipguard.sim.friction import GRAVITY_M_S2

MARGIN = (1.25, 2.0)
"""True force over the force needed."""
PAUSE_S = (1.0, 6.0)
WAY_MM = (5.0, 60.0)
SPEED_MM_S = (20.0, 150.0)
SHAKE_M_S2 = (0.05, 0.3)
SHAKE_HZ = (8.0, 25.0)
TOUCH_SHARE = 0.06
"""A passing touch: so much of the weight more, for a moment."""
TOUCH_S = (0.1, 0.4)
DRIFT_DEG = 0.15
DRIFT_S = (20.0, 60.0)
TOUCH_EVERY_S = 15.0
LIFT_MM, HIGH_MM = 100.0, 150.0
STOPPED_SHARE = 0.3
"""Of the arm's motions, so many are stopped on the way."""
SETTLE_S = 0.6
STEP_S = 2e-3
HOLD_NUMBERS = 10_000


@dataclass(frozen=True, slots=True)
class Hold:
    """One hold to be played. seconds: after the lift. margin: true force over needed."""

    trial: Trial
    margin: float
    seconds: float


@dataclass(frozen=True, slots=True)
class Held:
    """How it went. tightenings: after the lift; lifting: during it. slip_deg, wound_deg: true,
    at the end."""

    hold: Hold
    tightenings: int
    lifting: int
    seconds: float
    slip_deg: float
    wound_deg: float
    said: tuple[str, ...] = ()


def holds(minutes: float, seed: int = 0, each_s: float = 60.0) -> list[Hold]:
    """So many minutes of holds in all, over every object, both gels and every latency."""
    rng = np.random.default_rng([seed, 31])
    count = max(round(60.0 * minutes / each_s), 1)
    base = trials(count, 0, seed + 7)
    return [
        Hold(replace(base[k % len(base)], number=HOLD_NUMBERS + k), float(rng.uniform(*MARGIN)), each_s)
        for k in range(count)
    ]


def hold(plan: Hold, params: GuardParams | None = None) -> Held:
    """Play one; the same hold gives the same answer."""
    params = (params or GuardParams()).model_copy(update={"probe_height_mm": 0.0})
    trial = plan.trial
    rng = np.random.default_rng([trial.number, 17])
    world = world_of(trial, STEP_S)
    law = Law(params)
    sights = {finger: model_sight(trial, k, _drift(rng)) for k, finger in enumerate(FINGERS)}
    loop = Loop(world, law, sights, chances(trial), PERCEIVING_S)
    grip(loop, min(plan.margin * trial.needed_n / trial.scenario.gripper.gain, params.force_max_n))
    loop.wait(SETTLE_S + trial.latency_s)
    loop.ask(Request(RequestKind.LIFT, height_mm=LIFT_MM, speed_mm_s=trial.lift_speed_mm_s))
    loop.until(lambda: law.guard.law.phase is Phase.HOLDING, 8.0)
    loop.wait(SETTLE_S)
    lifting = _tightenings(loop)
    world.shake(loop.now_s, _shaking(rng, loop.now_s, plan.seconds))
    begun_s = loop.now_s
    while loop.now_s - begun_s < plan.seconds:
        loop.wait(float(rng.uniform(*PAUSE_S)))
        height_mm = world.arm_state(loop.now_s).height_mm
        way_mm = float(rng.uniform(*WAY_MM)) * (1.0 if height_mm < HIGH_MM else -1.0)
        world.command_lift(loop.now_s, way_mm, float(np.exp(rng.uniform(*np.log(SPEED_MM_S)))))
        if rng.random() < STOPPED_SHARE:
            loop.wait(float(rng.uniform(0.05, 0.3)))
            world.command_stop(loop.now_s)
    truth = loop.truth()
    return Held(
        hold=plan,
        tightenings=_tightenings(loop) - lifting,
        lifting=lifting,
        seconds=loop.now_s - begun_s,
        slip_deg=abs(truth.slip_deg),
        wound_deg=abs(truth.elastic_deg),
        said=tuple(loop.says),
    )


def _tightenings(loop: Loop) -> int:
    return sum(command.hold_force_n is not None and "slip" in (command.say or "") for _, command in loop.commands)


def _drift(rng: np.random.Generator) -> Drift:
    return Drift(DRIFT_DEG, float(rng.uniform(*DRIFT_S)), float(rng.uniform(0.0, 2.0 * math.pi)))


def _shaking(rng: np.random.Generator, from_s: float, seconds: float) -> Callable[[float], float]:
    """The arm's vibration all the time, and now and then a passing touch."""
    amplitude, hz = float(rng.uniform(*SHAKE_M_S2)), float(rng.uniform(*SHAKE_HZ))
    count = max(round(seconds / TOUCH_EVERY_S), 1)
    touches = [
        (from_s + float(rng.uniform(0.0, seconds)), float(rng.uniform(*TOUCH_S)), float(rng.choice((-1.0, 1.0))))
        for _ in range(count)
    ]

    def shaken(now_s: float) -> float:
        value = amplitude * math.sin(2.0 * math.pi * hz * now_s)
        for at_s, lasts_s, side in touches:
            if at_s <= now_s < at_s + lasts_s:
                value += side * TOUCH_SHARE * GRAVITY_M_S2 * math.sin(math.pi * (now_s - at_s) / lasts_s)
        return value

    return shaken
