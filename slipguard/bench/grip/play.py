"""One trial, played by one controller: grip too weakly, take the support away or lift, and see how far it slips."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from slipguard.bench.grip.controllers import REACHED_MM, FixedStep, Oracle, SlipguardController, UnguardedController
from slipguard.bench.grip.loop import FINGERS, Loop, Sight, Trace
from slipguard.bench.grip.rendered_perception import RenderedSight
from slipguard.bench.grip.setup import chances, grip, model_sight, world_of
from slipguard.bench.grip.trials import PERCEIVING_S, Trial
from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.params import GuardParams

Who = Literal["law", "nobody", "fixed step", "oracle"]
EVERYBODY: tuple[Who, ...] = ("law", "fixed step", "oracle", "nobody")
QUIET_S = 0.7
"""Between the grip and what happens then: the fingers take their reference and the law learns how still it is."""
AFTERWARDS_S = 3.0
LIFT_MM, HIGH_MM = 60.0, 150.0
"""How far the arm lifts; higher where the need is high: clear of the table, where nothing but the grip holds."""
STILL_DEG_S = 0.5
STILL_FOR_S = 0.35
"""A trial is over when the object has been at rest for so long beyond one latency."""
SLIPPED_DEG = 0.1


@dataclass(frozen=True, slots=True)
class Outcome:
    """How one trial went for one controller.

    slip_deg: true slip at the end, turn less wind-up; rotation_deg: largest true turn. arrested_s: from the first slip to
    the last; None without slip. tightenings: forces commanded after the grip. early: the first of them before any slip.
    trace: where asked for. fault: of the law, at the end. up: the arm has lifted the object as high as it was told to;
    of a support that went away, True.
    """

    who: Who
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
    says: tuple[str, ...] = ()
    trace: Trace | None = None

    @property
    def force_over_needed(self) -> float:
        """Highest true force over the force needed."""
        return self.force_n / self.needed_n


def play(
    trial: Trial, who: Who, *, rendered: bool = False, traced: bool = False, params: GuardParams | None = None
) -> Outcome:
    """Play it; the same trial gives the same outcome. rendered: through drawn frames and the shipped network."""
    loop = _loop(trial, who, rendered, within_budget(params or GuardParams(), trial))
    grip(loop, trial.first_n)
    loop.wait(QUIET_S + trial.latency_s + 6.0 / trial.fps)
    begun_s = loop.now_s
    _happen(loop, trial)
    _watch(loop, trial)
    return _outcome(loop, trial, who, begun_s, traced)


def within_budget(params: GuardParams, trial: Trial) -> GuardParams:
    """The parameters with the trial's budget, for a lift that begins at full speed."""
    told = {
        "force_max_n": trial.force_max_n,
        "no_estimate_force_n": min(params.no_estimate_force_n, trial.force_max_n),
        "tuning": params.tuning.model_dump() | {"probe_height_mm": 0.0},
    }
    return GuardParams.model_validate(params.model_dump() | told)


def lift_mm(trial: Trial) -> float:
    """How far it is lifted."""
    return LIFT_MM if trial.block == "matrix" else HIGH_MM


def _loop(trial: Trial, who: Who, rendered: bool, params: GuardParams) -> Loop:
    deliveries = {"left": trial.scenario.left, "right": trial.scenario.right}
    sights: dict[str, Sight] = {
        finger: RenderedSight(2 * trial.number + k, deliveries[finger]) if rendered else model_sight(trial, k)
        for k, finger in enumerate(FINGERS)
    }
    camera_s = deliveries["left"].latency_s + PERCEIVING_S
    controller: SlipguardController | UnguardedController
    if who == "law":
        controller = SlipguardController(params)
    elif who == "fixed step":
        controller = FixedStep(force_max_n=params.force_max_n)
    elif who == "oracle":
        gain = trial.scenario.gripper.gain
        controller = Oracle(latency_s=camera_s, gain=gain, force_max_n=params.force_max_n)
    else:
        controller = UnguardedController()
    return Loop(world_of(trial), controller, sights, chances(trial), PERCEIVING_S)


def _moves(loop: Loop) -> bool:
    return loop.world.gripper_state(loop.now_s).moving


def _happen(loop: Loop, trial: Trial) -> None:
    if trial.event == "support gone":
        loop.world.take_table(loop.now_s)
    else:
        loop.ask(ControlRequest(RequestKind.LIFT, height_mm=lift_mm(trial), speed_mm_s=trial.lift_speed_mm_s))


def _watch(loop: Loop, trial: Trial) -> None:
    """Run until it is up and has been at rest for long enough, is lost, or the time is over."""
    still_s = [loop.now_s]
    way_mm = _way_mm(trial)

    def over() -> bool:
        truth = loop.truth()
        if truth.dropped is not None:
            return True
        if abs(truth.rate_deg_s) > STILL_DEG_S or _moves(loop) or truth.height_mm < way_mm:
            still_s[0] = loop.now_s
        return loop.now_s - still_s[0] > STILL_FOR_S + trial.latency_s

    loop.until(over, AFTERWARDS_S + 2.0 * way_mm / trial.lift_speed_mm_s)


def _way_mm(trial: Trial) -> float:
    return lift_mm(trial) - REACHED_MM if trial.event == "lifted" else 0.0


def _outcome(loop: Loop, trial: Trial, who: Who, begun_s: float, traced: bool) -> Outcome:
    truth, trace = loop.truth(), loop.trace
    times = np.asarray(trace.time_s)
    slips = np.abs(np.asarray(trace.slip_deg))
    moved = times[(slips > SLIPPED_DEG) & (slips < abs(truth.slip_deg) - SLIPPED_DEG)]
    first_slip_s = float(times[slips > SLIPPED_DEG][0]) if (slips > SLIPPED_DEG).any() else None
    arrested_s = None if first_slip_s is None else float(moved[-1] - first_slip_s) if moved.size else 0.0
    told = [when_s for when_s, command in loop.commands if command.hold_force_n is not None and when_s >= begun_s]
    grasp = loop.controller.guard.grasp if isinstance(loop.controller, SlipguardController) else None
    return Outcome(
        who=who,
        slip_deg=abs(truth.slip_deg),
        rotation_deg=max(float(np.abs(trace.rotation_deg).max()), abs(truth.rotation_deg)),
        force_n=max(trace.force_n),
        needed_n=trial.needed_n,
        arrested_s=arrested_s,
        tightenings=len(told),
        early=bool(told and (first_slip_s is None or told[0] < first_slip_s)),
        dropped=truth.dropped,
        fault=str(grasp.fault.code) if grasp is not None and grasp.fault is not None else None,
        up=bool(truth.height_mm >= _way_mm(trial)),
        says=tuple(loop.says),
        trace=trace if traced else None,
    )
