"""An object that slips at the force limit goes back down the path just lifted, if configured."""

from __future__ import annotations

import pytest
from controller_steps import NOW_S, Play, seen_in, state_in
from observations import arm, ask, fused, gripper, guard_params, observation
from pydantic import ValidationError
from records import changed, released_mm

from slipguard.config import parse_config
from slipguard.control.control_step import step
from slipguard.control.messages import LiftArm, RequestKind, StepOutput, StopArm
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.devices import ArmState
from slipguard.errors import ConfigError

SMALL = {"force_max_n": 60.0, "no_estimate_force_n": 60.0, "lift_height_mm": 80.0}
LOWER = guard_params(on_force_limit="lower", **SMALL)
STOP = guard_params(**SMALL)


class Lifted(Play):
    """Lifted by 80 mm and slipping on with all of the force limit; the arm moves at the speed it is given."""

    def __init__(self, params: GuardParams) -> None:
        super().__init__(params)
        self.held()
        self.step(RequestKind.LIFT)
        self.steps(4.0)
        assert self.grasp.phase is Phase.HOLDING
        self.goal_mm, self.speed_mm_s = self.here.height_mm, 0.0
        self.reached_mm = self.here.height_mm

    def step(self, kind: RequestKind = RequestKind.NONE, **values: float) -> StepOutput:
        if not hasattr(self, "goal_mm"):
            return super().step(kind, **values)
        if self.here is not None:
            way_mm = self.goal_mm - self.here.height_mm
            step_mm = min(abs(way_mm), 0.02 * self.speed_mm_s) * (1.0 if way_mm > 0.0 else -1.0)
            self.here = changed(self.here, height_mm=self.here.height_mm + step_mm, moving=abs(way_mm) > 1e-9)
        before = self.here
        command = super().step(kind, **values)
        self.here = before
        if self.here is not None and isinstance(command.arm, LiftArm):
            self.goal_mm, self.speed_mm_s = self.here.height_mm + command.arm.height_mm, command.arm.speed_mm_s
        elif self.here is not None and command.arm == StopArm():
            self.goal_mm = self.here.height_mm
        return command

    def spend(self) -> StepOutput:
        """Slip on until there is nothing left; the command of the tick at which that was found."""
        for rotation_deg in range(4, 40, 2):
            self.view = changed(self.view, rotation_deg=float(rotation_deg), rate_deg_s=40.0)
            for _ in range(10):
                command = self.step()
                if command.fault is not None:
                    return command
        raise AssertionError("nothing was found")


def lifts(play: Play) -> list[LiftArm]:
    return [command.arm for command in play.commands if isinstance(command.arm, LiftArm)]


def test_it_goes_back_slowly_to_where_the_lift_began_and_stays_a_fault() -> None:
    play = Lifted(LOWER)
    before = len(lifts(play))
    command = play.spend()
    assert command.fault is not None
    assert command.fault.code is FaultCode.FORCE_LIMIT_REACHED
    assert command.arm == LiftArm(pytest.approx(-80.0, abs=0.6), 30.0)
    assert "putting the object down by 80 mm" in (command.text or "")
    play.steps(2.0)
    assert play.grasp.arm.putting_down
    assert "being put down" in str(play.step(RequestKind.CLEAR).refusal)
    said = [command.text for command in play.steps(3.0)]
    assert play.here.height_mm == pytest.approx(0.0, abs=0.6)
    assert any("put down where the lift began" in line for line in said if line)
    assert not play.grasp.arm.putting_down
    assert len(lifts(play)) == before + 1
    assert play.grasp.phase is Phase.FAULT
    assert play.grasp.fault == command.fault
    play.view = changed(play.view, rate_deg_s=0.0)
    assert all(command.arm != StopArm() for command in play.steps(0.2))
    assert play.step(RequestKind.CLEAR).refusal is None


def test_the_usual_is_to_stand() -> None:
    play = Lifted(STOP)
    command = play.spend()
    assert command.arm == StopArm()
    play.steps(2.0)
    assert play.here.height_mm == pytest.approx(80.0, abs=0.6)


def test_an_object_that_rotated_too_far_is_put_down_too() -> None:
    play = Lifted(LOWER)
    play.slips(4.0, 300.0)
    play.slips(50.0, 300.0)
    command = play.commands[-1]
    assert command.fault is not None
    assert command.fault.code is FaultCode.ROTATED_TOO_FAR
    assert isinstance(command.arm, LiftArm)
    assert play.grasp.grip.target_n == pytest.approx(60.0, abs=0.85)


def test_tightening_that_does_not_help_stops_as_ever() -> None:
    """There is force left: it is not known that nothing holds it."""
    play = Lifted(guard_params(on_force_limit="lower", lift_height_mm=80.0, tighten_effect_timeout_s=0.2))
    play.slips(4.0, 30.0)
    rotation_deg, command = 4.0, StepOutput()
    while command.fault is None:
        rotation_deg += 0.4
        command = play.slips(rotation_deg, 20.0, frames=1)
    assert command.fault.code is FaultCode.TIGHTENING_INEFFECTIVE
    assert command.arm == StopArm()
    assert not play.grasp.arm.putting_down


@pytest.mark.parametrize(
    "here",
    [
        pytest.param(lambda at: changed(at, protective_stop=True), id="protective stop"),
        pytest.param(lambda at: changed(at, emergency_stop=True), id="emergency stop"),
        pytest.param(lambda at: None, id="arm gone"),
    ],
)
def test_any_other_fault_stops_it_for_good(here: object) -> None:
    play = Lifted(LOWER)
    play.spend()
    play.steps(1.0)
    there, before = play.here, len(lifts(play))
    play.here = here(there)  # type: ignore[operator]
    command = play.step()
    assert command.arm == StopArm()
    assert "putting down stopped" in (command.text or "")
    play.steps(0.5)
    play.here = there
    play.steps(2.0)
    assert len(lifts(play)) == before
    assert not play.grasp.arm.putting_down
    assert play.grasp.fault is not None
    assert play.grasp.fault.code is FaultCode.FORCE_LIMIT_REACHED


@pytest.mark.parametrize(
    "view", [fused(None, contact=False, shift_mm=None), fused(20.0, 0.0, conflict="both the same way")]
)
def test_an_object_lost_or_not_seen_any_more_stops_it(view: object) -> None:
    play = Lifted(LOWER)
    play.spend()
    play.steps(0.5)
    play.view = view  # type: ignore[assignment]
    play.steps(1.2)
    assert not play.grasp.arm.putting_down
    assert any(command.arm == StopArm() for command in play.commands[-60:])
    said = " ".join(command.text for command in play.commands[-60:] if command.text)
    assert "object lost" in said or "estimate untrusted" in said


def test_slip_that_goes_on_does_not_stop_it() -> None:
    play = Lifted(LOWER)
    play.spend()
    for rotation_deg in range(40, 60):
        play.slips(float(rotation_deg), 40.0, frames=5)
    assert play.grasp.arm.putting_down
    assert FaultCode.TIGHTENING_INEFFECTIVE in play.grasp.reported.faults


def test_an_arm_that_ignores_the_command_gets_it_again_and_is_then_given_up() -> None:
    play = Lifted(LOWER)
    play.spend()
    before, there = len(lifts(play)), play.here
    for _ in range(150):
        play.here = changed(there, moving=False)
        play.goal_mm = there.height_mm
        play.step()
    assert len(lifts(play)) > before + 2
    assert not play.grasp.arm.putting_down
    assert FaultCode.ARM_STUCK in play.grasp.reported.faults or any(
        "arm stuck" in (c.text or "") for c in play.commands
    )


def test_a_release_on_the_way_stops_the_arm_and_opens() -> None:
    play = Lifted(LOWER)
    play.spend()
    play.steps(0.5)
    command = play.step(RequestKind.RELEASE)
    assert command.arm == StopArm()
    assert released_mm(command) is None
    assert not play.grasp.arm.putting_down
    play.here = changed(play.here, moving=False)
    assert released_mm(play.step()) == 85.0


@pytest.mark.parametrize(
    ("ground_mm", "here", "says", "stands"),
    [
        (None, arm(50.0, at_s=NOW_S), "where the lift began is unknown", True),
        (0.0, None, "where the lift began is unknown", True),
        (49.6, arm(50.0, at_s=NOW_S), "", True),
        (60.0, arm(50.0, at_s=NOW_S), "", True),
        (49.4, arm(50.0, at_s=NOW_S), "putting the object down by 1 mm", False),
        (0.0, arm(50.0, at_s=NOW_S, protective=True), "", True),
    ],
)
def test_where_it_cannot_go_down_it_stands(
    ground_mm: float | None, here: ArmState | None, says: str, stands: bool
) -> None:
    held = state_in(Phase.HOLDING, ground_mm=ground_mm)
    view = seen_in(Phase.HOLDING, fused=fused(50.0, 100.0, at_s=NOW_S), arm=here)
    state, _ = step(held, view, LOWER)
    later = NOW_S + 0.02
    again = changed(view, now_s=later, fused=fused(50.0, 100.0, at_s=later))
    state, command = step(state, again, LOWER)
    assert state.phase is Phase.FAULT
    assert says in (command.text or "")
    assert (command.arm == StopArm()) is stands
    assert state.arm.putting_down is not stands


def test_in_guard_mode_it_is_refused_with_a_reason() -> None:
    with pytest.raises(ValidationError, match="the arm belongs to another program"):
        guard_params(mode="guard", on_force_limit="lower")
    with pytest.raises(ConfigError, match="on_force_limit") as refusal:
        parse_config({"guard": {"mode": "guard", "on_force_limit": "lower"}}, where="cell.toml", sim=True)
    assert "\n" not in str(refusal.value)


# --- what else goes wrong while a fault is latched ---


def test_a_second_fault_is_reported_once_and_the_first_stays() -> None:
    play = Play().held()
    play.here = arm(protective=True)
    first = play.step().fault
    assert first is not None
    play.jaws = changed(play.jaws, fault="9")
    said = [command.text for command in play.steps(0.5) if command.text]
    assert len(said) == 1
    assert "gripper fault" in said[0]
    assert play.grasp.fault == first
    play.jaws = changed(play.jaws, fault=None)
    assert not [command.text for command in play.steps(0.2) if command.text]
    play.jaws = changed(play.jaws, fault="9")
    assert len([command.text for command in play.steps(0.2) if command.text]) == 1


def test_an_object_lost_in_a_fault_is_reported_and_can_be_cleared() -> None:
    play = Play().held()
    play.here = arm(protective=True)
    play.step()
    play.jaws = changed(play.jaws, holding=False, closed_on_nothing=True)
    said = [command.text for command in play.steps(0.5) if command.text]
    assert len(said) == 1
    assert "object lost: the gripper closed on nothing" in said[0]
    play.here = arm()
    command = play.step(RequestKind.CLEAR)
    assert command.text == "cleared; nothing is held"


def test_jaws_that_never_met_anything_lose_nothing() -> None:
    state, view = state_in(Phase.FAULT), observation(NOW_S, gripper=gripper(40.0, holding=False, at_s=NOW_S))
    for number in range(20):
        now_s = NOW_S + 0.02 * number
        state, command = step(state, changed(view, now_s=now_s), STOP)
        assert command.text is None
    assert not state.grip.closed
    state, _ = step(state, seen_in(Phase.FAULT), STOP)
    assert state.grip.closed


def test_asked_to_clear_while_nothing_is_latched() -> None:
    _, command = step(state_in(Phase.HOLDING), seen_in(Phase.HOLDING, request=ask(RequestKind.CLEAR)), STOP)
    assert str(command.refusal) == "no fault is latched"


def test_a_silent_arm_is_not_commanded_to_move() -> None:
    for age_s, moves in ((0.09, True), (0.11, False)):
        view = seen_in(Phase.LIFTING, arm=arm(15.0, at_s=NOW_S - age_s))
        _, command = step(state_in(Phase.LIFTING), view, STOP)
        assert isinstance(command.arm, LiftArm) is moves


def test_an_object_is_put_down_from_a_recent_height() -> None:
    """With an old state the arm is stopped, and goes down as soon as it has reported where it stands."""
    held = state_in(Phase.HOLDING, ground_mm=0.0)
    for now_s in (NOW_S, NOW_S + 0.02):
        sight = fused(50.0, 100.0, at_s=now_s)
        view = seen_in(Phase.HOLDING, now_s=now_s, fused=sight, arm=arm(50.0, at_s=NOW_S - 0.15))
        held, command = step(held, view, LOWER)
    assert command.arm == StopArm()
    assert held.arm.putting_down
    now_s += 0.3
    fresh = arm(45.0, at_s=now_s)
    view = seen_in(Phase.HOLDING, now_s=now_s, fused=fused(50.0, 100.0, at_s=now_s), arm=fresh)
    held, command = step(held, changed(view, gripper=gripper(129.0, at_s=now_s)), LOWER)
    assert isinstance(command.arm, LiftArm)
    assert command.arm.height_mm == -45.0
