"""Stable holds: the gel twists but the object does not slip, so that every tightening is a false one.

Each hold starts with a lift, in which the gel winds up under the weight. Then, for minutes, the arm starts and stops,
vibrates, the object is touched, the light drifts, single frames have errors, and a finger's frames are lost. The grip
is firm.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from slipguard.bench.grip.closed_loop import FINGERS, ClosedLoop, FingerModel
from slipguard.bench.grip.controllers import SlipguardController
from slipguard.bench.grip.perception_models import ModeledFinger, RenderedFinger, RotationDrift, RotationOutliers
from slipguard.bench.grip.trial_run import delivery_rng, grip, modeled_finger, world_of
from slipguard.bench.grip.trials import PERCEIVING_S, GripTrial, trials
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.limit_surface import GRAVITY_M_S2
from slipguard.sim.world import WorldTruth

SHAKE_M_S2 = (0.05, 0.3)
SHAKE_HZ = (8.0, 25.0)
TOUCH_SHARE = 0.06
"""Additional load by a short touch, relative to the weight."""
TOUCH_S = (0.1, 0.4)
TOUCH_EVERY_S = 15.0
DRIFT_DEG = 0.15
DRIFT_S = (20.0, 60.0)
OUTLIER_DEG = 0.6
"""Error of a single frame in both fingers, such as a flicker that both cameras share."""
OUTLIER_EVERY_S = 12.0
OUTAGE_S = (0.05, 0.8)
OUTAGE_EVERY_S = 20.0
"""Time in which one finger's frames are lost."""


def drift(rng: np.random.Generator) -> RotationDrift:
    """Return the rotation error by a slow change of the light."""
    return RotationDrift(DRIFT_DEG, float(rng.uniform(*DRIFT_S)), float(rng.uniform(0.0, 2.0 * math.pi)))


def outliers(rng: np.random.Generator, from_s: float, seconds: float) -> dict[str, RotationOutliers]:
    """Return by finger the errors of the same frames, with opposite image signs."""
    times_s = sorted(from_s + float(rng.uniform(0.0, seconds)) for _ in range(_count(seconds, OUTLIER_EVERY_S)))
    deg = float(rng.choice((-1.0, 1.0))) * OUTLIER_DEG
    return {finger: RotationOutliers(times_s, sign * deg) for finger, sign in zip(FINGERS, (1.0, -1.0), strict=True)}


def outages(rng: np.random.Generator, from_s: float, seconds: float) -> Callable[[str, float], bool]:
    """Return a function: whether a finger's frames are lost at a time."""
    each = [
        (str(rng.choice(FINGERS)), from_s + float(rng.uniform(0.0, seconds)), float(rng.uniform(*OUTAGE_S)))
        for _ in range(_count(seconds, OUTAGE_EVERY_S))
    ]
    return lambda finger, now_s: any(finger == one and at_s <= now_s < at_s + lasts_s for one, at_s, lasts_s in each)


def shaking(rng: np.random.Generator, from_s: float, seconds: float) -> Callable[[float], float]:
    """Return the acceleration over time in m/s², upwards: vibration of the arm, and touches."""
    amplitude, hz = float(rng.uniform(*SHAKE_M_S2)), float(rng.uniform(*SHAKE_HZ))
    touches = [
        (from_s + float(rng.uniform(0.0, seconds)), float(rng.uniform(*TOUCH_S)), float(rng.choice((-1.0, 1.0))))
        for _ in range(_count(seconds, TOUCH_EVERY_S))
    ]

    def shaken(now_s: float) -> float:
        value = amplitude * math.sin(2.0 * math.pi * hz * now_s)
        for at_s, lasts_s, side in touches:
            if at_s <= now_s < at_s + lasts_s:
                value += side * TOUCH_SHARE * GRAVITY_M_S2 * math.sin(math.pi * (now_s - at_s) / lasts_s)
        return value

    return shaken


def _count(seconds: float, every_s: float) -> int:
    return max(round(seconds / every_s), 1)


MARGIN = (1.25, 2.0)
"""True force relative to the needed force."""
PAUSE_S = (1.0, 6.0)
WAY_MM = (5.0, 60.0)
SPEED_MM_S = (20.0, 150.0)
LIFT_MM, HIGH_MM = 100.0, 150.0
STOPPED_SHARE = 0.3
"""Share of arm motions that are stopped early."""
SETTLE_S = 0.6
STEP_S = 2e-3
LIFTS_WITHIN_S = 8.0
HOLD_NUMBERS, RENDERED_NUMBERS = 10_000, 11_000
SLIP_DEG = 0.1
TRANSLATES_MM_S = 0.5
"""Above this rate a slipping object translates; slower motion ends within a micrometer."""
RECENT_S = 2.0
"""Without translation and below this true slip in this time (or since the last tightening), nothing slips."""


@dataclass(frozen=True, slots=True)
class StableHold:
    """One hold. seconds: after the lift. margin: true force over needed force. rendered: with the shipped pipeline."""

    trial: GripTrial
    margin: float
    seconds: float
    rendered: bool = False


@dataclass(frozen=True, slots=True)
class HoldOutcome:
    """Result of a hold.

    Attributes:
        tightenings: Tightenings after the lift; lifting: during it.
        false: Those of both without slip; false_lifting: of these, during the lift.
        slip_deg: True slip at the end; elastic_deg: true elastic torsion.
        failed: Why the object was not held to the end; None if it was.
    """

    hold: StableHold
    tightenings: int
    lifting: int
    false: int
    false_lifting: int
    seconds: float
    slip_deg: float
    elastic_deg: float
    failed: str | None = None
    messages: tuple[str, ...] = ()


def holds(minutes: float, seed: int = 0, each_s: float = 60.0, *, rendered: bool = False) -> list[StableHold]:
    """Return holds of `minutes` in total, over every object, both gels and every latency."""
    rng = np.random.default_rng([seed, 37 if rendered else 31])
    count = max(round(60.0 * minutes / each_s), 1)
    base = trials(count, 0, seed + (8 if rendered else 7))
    first = RENDERED_NUMBERS if rendered else HOLD_NUMBERS
    return [
        StableHold(replace(base[k % len(base)], number=first + k), float(rng.uniform(*MARGIN)), each_s, rendered)
        for k in range(count)
    ]


def run_hold(plan: StableHold, params: GuardParams | None = None) -> HoldOutcome:
    """Run a hold; equal holds give equal results."""
    params = params or GuardParams()
    params = params.model_copy(update={"tuning": params.tuning.model_copy(update={"probe_height_mm": 0.0})})
    trial = plan.trial
    rng = np.random.default_rng([trial.number, 17])
    world = world_of(trial, STEP_S)
    controller = SlipguardController(params)
    loop = ClosedLoop(world, controller, _fingers(plan, rng), delivery_rng(trial), PERCEIVING_S)
    grip(loop, min(plan.margin * trial.needed_n / trial.scenario.gripper.gain, params.force_max_n))
    loop.wait(SETTLE_S + trial.latency_s)
    lifted_s = loop.now_s
    loop.ask(ControlRequest(RequestKind.LIFT, height_mm=LIFT_MM, speed_mm_s=trial.lift_speed_mm_s))
    if not loop.until(lambda: controller.state.grasp.phase is Phase.HOLDING, LIFTS_WITHIN_S):
        fault = controller.state.grasp.fault
        return _held(
            plan, loop, lifted_s, loop.now_s, f"not holding after the lift: {fault or controller.state.grasp.phase}"
        )
    loop.wait(SETTLE_S)
    _disturb(loop, rng, plan.seconds)
    begun_s = loop.now_s
    while loop.now_s - begun_s < plan.seconds:
        loop.wait(float(rng.uniform(*PAUSE_S)))
        height_mm = world.arm_state(loop.now_s).height_mm
        way_mm = float(rng.uniform(*WAY_MM)) * (1.0 if height_mm < HIGH_MM else -1.0)
        world.command_lift(loop.now_s, way_mm, float(np.exp(rng.uniform(*np.log(SPEED_MM_S)))))
        if rng.random() < STOPPED_SHARE:
            loop.wait(float(rng.uniform(0.05, 0.3)))
            world.command_stop(loop.now_s)
    fault = controller.state.grasp.fault
    return _held(plan, loop, lifted_s, begun_s, None if fault is None else str(fault))


def _fingers(plan: StableHold, rng: np.random.Generator) -> dict[str, FingerModel]:
    trial = plan.trial
    if plan.rendered:
        deliveries = (trial.scenario.left, trial.scenario.right)
        return {f: RenderedFinger(2 * trial.number + k, deliveries[k]) for k, f in enumerate(FINGERS)}
    return {finger: modeled_finger(trial, k, drift(rng)) for k, finger in enumerate(FINGERS)}


def _disturb(loop: ClosedLoop, rng: np.random.Generator, seconds: float) -> None:
    loop.world.shake(loop.now_s, shaking(rng, loop.now_s, seconds))
    off = outliers(rng, loop.now_s, seconds)
    for name, finger in loop.fingers.items():
        if isinstance(finger, ModeledFinger):
            finger.add_outliers(off[name])
    loop.outage = outages(rng, loop.now_s, seconds)


def _held(plan: StableHold, loop: ClosedLoop, lifted_s: float, begun_s: float, failed: str | None) -> HoldOutcome:
    truth = loop.truth()
    tightened_s = [at_s for at_s, output in loop.outputs if output.hold_force_n is not None and at_s > lifted_s]
    wrong = _false_tightenings(tightened_s, loop.trace, lifted_s)
    return HoldOutcome(
        hold=plan,
        tightenings=sum(at_s >= begun_s for at_s in tightened_s),
        lifting=sum(at_s < begun_s for at_s in tightened_s),
        false=len(wrong),
        false_lifting=sum(at_s < begun_s for at_s in wrong),
        seconds=loop.now_s - begun_s,
        slip_deg=abs(truth.slip_deg),
        elastic_deg=abs(truth.elastic_deg),
        failed=failed if truth.dropped is None else f"dropped: {truth.dropped}",
        messages=tuple(loop.messages),
    )


def _false_tightenings(tightened_s: list[float], trace: Sequence[WorldTruth], from_s: float) -> list[float]:
    """Return the tightenings without a true slip or translation shortly before and since the last tightening.

    An earlier slip does not justify a second tightening.
    """
    times_s, slips_deg = (np.array([getattr(now, name) for now in trace]) for name in ("time_s", "slip_deg"))
    translates = np.array([now.slipping and abs(now.slip_rate_mm_s) > TRANSLATES_MM_S for now in trace])
    found = []
    for at_s in tightened_s:
        since = (times_s >= max(from_s, at_s - RECENT_S)) & (times_s <= at_s)
        slipped = since.any() and np.ptp(slips_deg[since]) >= SLIP_DEG
        if not (slipped or translates[since].any()):
            found.append(at_s)
        from_s = at_s
    return found
