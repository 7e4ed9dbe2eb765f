"""States and observations in every phase, and the controller on devices that carry out each command at once."""

from __future__ import annotations

from observations import arm, ask, fused, gripper, guard_params, observation
from records import changed, grasp_state, load_state, released_mm

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.load_state import STIFFNESS_PRIOR
from slipguard.control.messages import LiftArm, Observation, RequestKind, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import GraspState, Phase, Release
from slipguard.devices import FINGERS

PARAMS = guard_params()
GUARD_MODE = guard_params(mode="guard")
NOW_S = 10.0
FAULT = Fault(FaultCode.ARM_SILENT, "no state for 0.5 s", "check the network")
GUARDED = load_state(measured_s=NOW_S - 0.02, captured_s=NOW_S - 0.02, lowest_mm=0.0).started(STIFFNESS_PRIOR, 40.0)
"""The load of an object at rest since the grip."""


def state_in(phase: Phase, **changes: object) -> GraspState:
    """Return a plausible state of a phase that began half a second ago."""
    held = phase not in (Phase.IDLE, Phase.RELEASED)
    released = phase is Phase.RELEASED
    base = grasp_state(
        phase, since_s=NOW_S - 0.5, adopted=True, target_n=40.0 if held else 0.0, commanded_s=NOW_S - 0.5,
        load=GUARDED, referenced=held, ground_mm=0.0 if held else None, arm_commanded_s=NOW_S - 0.5,
        goal_mm={Phase.LIFTING: 100.0, Phase.LOWERING: 0.0}.get(phase), fault=FAULT if phase is Phase.FAULT else None,
        release=Release(85.0) if released else None, release_requested=released,
        seen_by=frozenset(FINGERS) if held and phase is not Phase.CLOSING else frozenset(),
    )  # fmt: skip
    return changed(base, **changes)


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
    return changed(base, **changes)  # type: ignore[arg-type]


class Play:
    """The controller on a simple gripper and arm that execute commands at once."""

    def __init__(self, params: GuardParams = PARAMS, guard: ControlState | None = None) -> None:
        self.params, self.guard, self.now_s = params, guard or ControlState(), 100.0
        self.jaws = gripper(0.0, holding=False, width_mm=85.0)
        self.here = arm()
        self.view = fused(None, contact=False, shift_mm=None)
        self.commands: list[StepOutput] = []
        self.lazy = False
        self.opens = True
        """Whether a release has an effect."""

    def step(self, kind: RequestKind = RequestKind.NONE, **values: float) -> StepOutput:
        self.now_s += 0.02
        if not self.lazy:
            self.view = changed(self.view, captured_at_s=self.now_s, measured_at_s=self.now_s)
        jaws = self.jaws and changed(self.jaws, measured_at_s=self.now_s)
        here = self.here and changed(self.here, measured_at_s=self.now_s)
        view = observation(self.now_s, fused=self.view, gripper=jaws, arm=here, request=ask(kind, **values))
        self.guard, command = control_step(self.guard, view, self.params)
        self.commands.append(command)
        if command.hold_force_n is not None:
            self.jaws = changed(self.jaws, force_n=command.hold_force_n, holding=True)
        if released_mm(command) is not None and self.opens:
            width_mm = self.jaws.width_mm + 20.0
            self.jaws = changed(self.jaws, force_n=0.0, holding=False, width_mm=width_mm)
            self.view = fused(None, contact=False, shift_mm=None)
        if isinstance(command.arm, LiftArm):
            self.here = changed(self.here, height_mm=self.here.height_mm + command.arm.height_mm)
        return command

    def steps(self, seconds: float) -> list[StepOutput]:
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

    def slips(self, rotation_deg: float = 4.0, rate_deg_s: float = 30.0, frames: int = 2) -> StepOutput:
        """Measured frames of slip; the first one's command that tightens, or the last one's."""
        self.view = changed(self.view, rotation_deg=rotation_deg, rate_deg_s=rate_deg_s)
        commands = [self.step() for _ in range(frames)]
        return next((command for command in commands if command.hold_force_n is not None), commands[-1])
