"""Run of one trial with one controller: grip too weakly, remove the support or lift, and measure the slip."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slipguard.bench.grip.closed_loop import FINGERS, ClosedLoop, FingerModel
from slipguard.bench.grip.controllers import REACHED_MM, FixedStep, Oracle, SlipguardController, UnguardedController
from slipguard.bench.grip.perception_models import (
    PERCEPTION_ERRORS,
    ModeledFinger,
    PerceptionErrors,
    RenderedFinger,
    RotationDrift,
)
from slipguard.bench.grip.trials import PERCEIVING_S, ROOM_MM, GripTrial
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.params import GuardParams
from slipguard.sim.world import World, WorldSettings, WorldTruth

START_S = 100.0
CLOSING_MAX_S = 6.0


def world_of(trial: GripTrial, step_s: float = 1e-3) -> World:
    settings = WorldSettings(step_s=step_s, start_width_mm=trial.item.width_mm + ROOM_MM)
    world = World(settings, seed=trial.number, lookup=lambda name: trial.item)
    world.place(trial.scenario, START_S)
    return world


def modeled_finger(trial: GripTrial, finger: int, drift: RotationDrift | None = None) -> ModeledFinger:
    error = PERCEPTION_ERRORS.get(trial.item.name, PerceptionErrors())
    return ModeledFinger(error, np.random.default_rng([trial.number, finger]), drift)


def delivery_rng(trial: GripTrial) -> np.random.Generator:
    """Return the generator for lost frames and time stamps, equal for all controllers of a trial."""
    return np.random.default_rng([trial.number, 9])


def grip(loop: ClosedLoop, force_n: float) -> None:
    """Close the jaws until the grip is firm; the cameras expose from then on."""
    loop.exposing = False
    loop.ask(ControlRequest(RequestKind.GRASP, force_n=force_n))

    def firm() -> bool:
        state = loop.world.gripper_state(loop.now_s)
        return state.holding and not state.moving

    assert loop.until(firm, CLOSING_MAX_S), "the jaws did not close"
    loop.exposing = True


ControllerName = Literal["slipguard", "unguarded", "fixed step", "oracle"]
CONTROLLER_NAMES: tuple[ControllerName, ...] = ("slipguard", "fixed step", "oracle", "unguarded")
QUIET_S = 0.7
"""Time after the grip in which the fingers take their reference and the controller measures the noise at rest."""
AFTERWARDS_S = 3.0
LIFT_MM, HIGH_MM = 60.0, 150.0
"""Height of a lift, and of a lift with a high need, which must leave the table."""
STILL_DEG_S = 0.5
STILL_FOR_S = 0.35
"""A trial ends when the object has been at rest for this time plus one latency."""
SLIPPED_DEG = 0.1


@dataclass(frozen=True, slots=True)
class TrialOutcome:
    """Result of one trial with one controller.

    Attributes:
        slip_deg: True slip at the end: rotation without elastic torsion.
        rotation_deg: Largest true rotation.
        arrested_s: Time from the first to the last slip; None without slip.
        tightenings: Forces commanded after the grip.
        early: Whether the first of them preceded any slip.
        fault: Fault of the controller at the end.
        up: Whether the object was lifted to the requested height; True if the support was removed.
        trace: The course of the run, if requested.
    """

    controller: ControllerName
    slip_deg: float
    rotation_deg: float
    force_n: float
    needed_n: float
    arrested_s: float | None
    tightenings: int
    early: bool
    dropped: str | None
    fault: str | None = None
    up: bool = True
    messages: tuple[str, ...] = ()
    trace: list[WorldTruth] | None = None

    @property
    def force_over_needed(self) -> float:
        return self.force_n / self.needed_n


def run_trial(
    trial: GripTrial,
    controller: ControllerName,
    *,
    rendered: bool = False,
    traced: bool = False,
    params: GuardParams | None = None,
) -> TrialOutcome:
    """Run a trial; equal trials give equal outcomes. rendered: with rendered frames and the shipped pipeline."""
    loop = _loop(trial, controller, rendered, trial_params(params or GuardParams(), trial))
    grip(loop, trial.first_n)
    loop.wait(QUIET_S + trial.latency_s + 6.0 / trial.fps)
    begun_s = loop.now_s
    _disturb(loop, trial)
    _run_to_rest(loop, trial)
    return _outcome(loop, trial, controller, begun_s, traced)


def trial_params(params: GuardParams, trial: GripTrial) -> GuardParams:
    """Return the parameters with the trial's force limit, for a lift that starts at full speed."""
    changed = {
        "force_max_n": trial.force_max_n,
        "no_estimate_force_n": min(params.no_estimate_force_n, trial.force_max_n),
        "tuning": params.tuning.model_dump() | {"probe_height_mm": 0.0},
    }
    return GuardParams.model_validate(params.model_dump() | changed)


def lift_mm(trial: GripTrial) -> float:
    return LIFT_MM if trial.block == "matrix" else HIGH_MM


def _loop(trial: GripTrial, name: ControllerName, rendered: bool, params: GuardParams) -> ClosedLoop:
    deliveries = {"left": trial.scenario.left, "right": trial.scenario.right}
    fingers: dict[str, FingerModel] = {
        finger: RenderedFinger(2 * trial.number + k, deliveries[finger]) if rendered else modeled_finger(trial, k)
        for k, finger in enumerate(FINGERS)
    }
    camera_s = deliveries["left"].latency_s + PERCEIVING_S
    controller: SlipguardController | UnguardedController
    if name == "slipguard":
        controller = SlipguardController(params)
    elif name == "fixed step":
        controller = FixedStep(force_max_n=params.force_max_n)
    elif name == "oracle":
        gain = trial.scenario.gripper.gain
        controller = Oracle(latency_s=camera_s, gain=gain, force_max_n=params.force_max_n)
    else:
        controller = UnguardedController()
    return ClosedLoop(world_of(trial), controller, fingers, delivery_rng(trial), PERCEIVING_S)


def _moves(loop: ClosedLoop) -> bool:
    return loop.world.gripper_state(loop.now_s).moving


def _disturb(loop: ClosedLoop, trial: GripTrial) -> None:
    if trial.event == "support gone":
        loop.world.take_table(loop.now_s)
    else:
        loop.ask(ControlRequest(RequestKind.LIFT, height_mm=lift_mm(trial), speed_mm_s=trial.lift_speed_mm_s))


def _run_to_rest(loop: ClosedLoop, trial: GripTrial) -> None:
    """Run until the object is lifted and at rest, is dropped, or the time is over."""
    still_s = [loop.now_s]
    goal_mm = _goal_mm(trial)

    def over() -> bool:
        truth = loop.truth()
        if truth.dropped is not None:
            return True
        if abs(truth.rate_deg_s) > STILL_DEG_S or _moves(loop) or truth.height_mm < goal_mm:
            still_s[0] = loop.now_s
        return loop.now_s - still_s[0] > STILL_FOR_S + trial.latency_s

    loop.until(over, AFTERWARDS_S + 2.0 * goal_mm / trial.lift_speed_mm_s)


def _goal_mm(trial: GripTrial) -> float:
    return lift_mm(trial) - REACHED_MM if trial.event == "lifted" else 0.0


def _outcome(loop: ClosedLoop, trial: GripTrial, name: ControllerName, begun_s: float, traced: bool) -> TrialOutcome:
    truth, trace = loop.truth(), loop.trace
    times = np.array([now.time_s for now in trace])
    slips = np.abs([now.slip_deg for now in trace])
    moved = times[(slips > SLIPPED_DEG) & (slips < abs(truth.slip_deg) - SLIPPED_DEG)]
    first_slip_s = float(times[slips > SLIPPED_DEG][0]) if (slips > SLIPPED_DEG).any() else None
    arrested_s = None if first_slip_s is None else float(moved[-1] - first_slip_s) if moved.size else 0.0
    tightened_s = [when_s for when_s, output in loop.outputs if output.hold_force_n is not None and when_s >= begun_s]
    grasp = loop.controller.state.grasp if isinstance(loop.controller, SlipguardController) else None
    return TrialOutcome(
        controller=name,
        slip_deg=abs(truth.slip_deg),
        rotation_deg=max(abs(now.rotation_deg) for now in (*trace, truth)),
        force_n=max(now.force_n for now in trace),
        needed_n=trial.needed_n,
        arrested_s=arrested_s,
        tightenings=len(tightened_s),
        early=bool(tightened_s and (first_slip_s is None or tightened_s[0] < first_slip_s)),
        dropped=truth.dropped,
        fault=str(grasp.fault.code) if grasp is not None and grasp.fault is not None else None,
        up=bool(truth.height_mm >= _goal_mm(trial)),
        messages=tuple(loop.messages),
        trace=trace if traced else None,
    )
