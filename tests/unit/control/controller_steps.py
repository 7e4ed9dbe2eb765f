"""Memories and views in every phase, and the law played against devices that do at once what they are told."""

from __future__ import annotations

from dataclasses import replace

from observations import arm, ask, fused, gripper, guard_params, observation

from slipguard.control.fault import Fault, FaultCode
from slipguard.control.messages import ArmLift, Command, Observation, RequestKind
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import SlipMemory
from slipguard.control.slip_thresholds import MotionCase, RestingPlace
from slipguard.control.state import GraspState, Phase
from slipguard.control.step import ControlState, control_step

COARSE = {
    "tighten_at_rest_deg": 10.0, "tighten_at_lift_off_deg": 10.0, "first_fraction": 0.1, "first_multiplier": 1.5,
}  # fmt: skip
"""No level but those that hold whatever the arm does, and steps that follow from the present force alone."""
PARAMS = guard_params(**COARSE)
GUARD_MODE = guard_params(mode="guard", **COARSE)
NOW_S = 10.0
FAULT = Fault(FaultCode.ARM_SILENT, "no state for 0.5 s", "check the network")
PRIMED = SlipMemory(
    base_rotation_deg=0.0, base_shift_mm=0.0, measured_s=NOW_S - 0.02, captured_s=NOW_S - 0.02, frames=1,
    smooth_shift_mm=0.0, rest_rotation_deg=0.0, rest_shift_mm=0.0, rest_since_s=NOW_S - 2.0,
    alert=RestingPlace(start_mm=0.0, near_deg=0.0, measured_s=NOW_S - 0.02, case=MotionCase.REST),
)  # fmt: skip
"""One frame of slip has been seen already."""


def state_in(phase: Phase, **changes: object) -> GraspState:
    """A plausible memory in a phase that began two seconds ago."""
    held = phase not in (Phase.IDLE, Phase.RELEASED)
    base = GraspState(
        phase=phase, since_s=NOW_S - 0.5, adopted=True, target_n=40.0 if held else 0.0, commanded_s=NOW_S - 0.5,
        detector=PRIMED, referenced=held, ground_mm=0.0 if held else None, arm_sent_s=NOW_S - 0.5,
        goal_mm={Phase.LIFTING: 100.0, Phase.LOWERING: 0.0, Phase.RELEASED: 85.0}.get(phase),
        fault=FAULT if phase is Phase.FAULT else None, release_requested=phase is Phase.RELEASED,
    )  # fmt: skip
    return replace(base, **changes)  # type: ignore[arg-type]


def seen_in(phase: Phase, **changes: object) -> Observation:
    """What fits that phase at NOW_S, before anything happens."""
    jaws = {
        Phase.IDLE: gripper(0.0, holding=False, width_mm=85.0, at_s=NOW_S),
        Phase.CLOSING: gripper(40.0, holding=False, moving=True, at_s=NOW_S),
        Phase.RELEASED: gripper(0.0, holding=False, moving=True, at_s=NOW_S),
    }.get(phase, gripper(40.0, at_s=NOW_S))
    rising = arm(50.0, moving=phase in (Phase.LIFTING, Phase.LOWERING), at_s=NOW_S)
    touches = phase not in (Phase.IDLE, Phase.CLOSING, Phase.RELEASED)
    none = fused(None, shift_mm=None, contact=False, at_s=NOW_S)
    # the reference is still awaited in REFERENCE
    view = fused(at_s=NOW_S) if touches and phase is not Phase.REFERENCE else fused(None, shift_mm=None, at_s=NOW_S)
    base = observation(NOW_S, gripper=jaws, arm=rising, fused=view if touches else none)
    return replace(base, **changes)  # type: ignore[arg-type]


class Play:
    """The law on a simple gripper and arm that do at once what they are told."""

    def __init__(self, params: GuardParams = PARAMS, guard: ControlState | None = None) -> None:
        self.params, self.guard, self.now_s = params, guard or ControlState(), 100.0
        self.jaws = gripper(0.0, holding=False, width_mm=85.0)
        self.here = arm()
        self.view = fused(None, contact=False, shift_mm=None)
        self.commands: list[Command] = []
        self.lazy = False

    def step(self, kind: RequestKind = RequestKind.NONE, **values: float) -> Command:
        self.now_s += 0.02
        if not self.lazy:
            self.view = replace(self.view, captured_at_s=self.now_s, measured_at_s=self.now_s)
        jaws = self.jaws and replace(self.jaws, measured_at_s=self.now_s)
        here = self.here and replace(self.here, measured_at_s=self.now_s)
        view = observation(self.now_s, fused=self.view, gripper=jaws, arm=here, request=ask(kind, **values))
        self.guard, command = control_step(self.guard, view, self.params)
        self.commands.append(command)
        if command.hold_force_n is not None:
            self.jaws = replace(self.jaws, force_n=command.hold_force_n, holding=True)
        if command.release_width_mm is not None:
            self.jaws = replace(self.jaws, force_n=0.0, holding=False)
        if isinstance(command.arm, ArmLift):
            self.here = replace(self.here, height_mm=self.here.height_mm + command.arm.height_mm)
        return command

    def steps(self, seconds: float) -> list[Command]:
        return [self.step() for _ in range(round(seconds / 0.02))]

    @property
    def grasp(self) -> GraspState:
        return self.guard.grasp

    def held(self) -> Play:
        """Grasped and with a reference, on the table."""
        self.step(RequestKind.GRASP)
        self.step()
        self.view = fused()
        self.step()
        assert self.grasp.phase is Phase.HOLDING
        self.steps(0.5)
        return self

    def slips(self, rotation_deg: float = 4.0, rate_deg_s: float = 30.0, frames: int = 2) -> Command:
        """Measured frames of slip; the last one's command."""
        self.view = replace(self.view, rotation_deg=rotation_deg, rate_deg_s=rate_deg_s)
        return [self.step() for _ in range(frames)][-1]
