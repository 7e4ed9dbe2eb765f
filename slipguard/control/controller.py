"""The grip law: one pure step from what is seen to what is commanded.

Order of every tick: a release is granted at once; then faults; then the phase; then what else was asked. Whatever goes
wrong, the grip that is there is kept, the arm stops, and it is said. Nothing but a request to release opens the jaws.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

from slipguard.control import adoption as adopting
from slipguard.control import arm_motion as motion
from slipguard.control import force_limits as limits
from slipguard.control import gripper_delay as delay
from slipguard.control import halt, release, requests
from slipguard.control.arm_motion import REACHED_MM, REPEAT_S
from slipguard.control.fault import Fault, FaultCode
from slipguard.control.guarding import GuardResult, guard
from slipguard.control.messages import Command, Observation, RequestKind, in_one_line, without_figures
from slipguard.control.params import GuardParams
from slipguard.control.state import (
    AT_STAKE,
    FORCE_TOLERANCE_N,
    GraspState,
    Phase,
    emptied,
    entered,
    taken_over,
    waiting,
)

LOST_ALONE_TIMES = 3.0
"""One finger's word for a loss, where the other says nothing and the gripper knows nothing of it, must last so long."""

SPOKEN_OF = AT_STAKE - {Phase.CLOSING, Phase.REFERENCE}
"""Phases in which a finger that goes blind is said; in FAULT, too, while something is held."""
NOTE_OVER_S = 1.0
"""What comes and goes within this is one trouble, and said once."""

Outcome = tuple[GraspState, Command]


def step(state: GraspState, observation: Observation, params: GuardParams) -> tuple[GraspState, Command]:
    """The next state and what to command now.

    Pure; meant to be called every few milliseconds and on every new estimate.
    """
    if observation.arm is not None:
        state = halt.near(state, observation.arm.protective_stop or observation.arm.emergency_stop)
    elif state.ground_mm is not None:
        state = replace(state, ground_mm=None)  # an arm that comes back counts its height from where it is found
    if observation.request.kind is RequestKind.RELEASE:
        return release.ask(state, observation, params)
    state, watched = _watch_object(state, observation, params)
    at_stake = state.phase in AT_STAKE or (state.phase is Phase.IDLE and waiting(state))
    if watched.fault is not None and at_stake:
        state, command = _latch(state, watched, watched.fault, Command())
        return halt.jaws(state, observation, command)
    state, command = _PHASES[state.phase](state, watched, params)
    state, command = _keep_force(state, observation, command)
    state, command = halt.jaws(state, observation, command)
    state, command = _tell_notes(state, observation, command)
    state, command = requests.answer(state, command, observation, params)
    return state, command if command.fault is state.fault else replace(command, fault=state.fault)


# --- faults ---


def _watch_object(state: GraspState, observation: Observation, params: GuardParams) -> tuple[GraspState, Observation]:
    """The loss of the object, after it has lasted `lost_s`, is added to what the supervisor finds wrong."""
    held = (state.phase in AT_STAKE and state.phase is not Phase.CLOSING) or (
        state.phase is Phase.FAULT and state.gripped
    )
    why = _loss(observation) if held else None
    if why is None:
        return (state if state.lost_since_s is None else replace(state, lost_since_s=None)), observation
    since_s = state.lost_since_s if state.lost_since_s is not None else observation.now_s
    state = replace(state, lost_since_s=since_s)
    if observation.now_s - since_s < params.tuning.lost_after_s * (LOST_ALONE_TIMES if _in_doubt(observation) else 1.0):
        return state, observation
    lost = Fault(FaultCode.OBJECT_LOST, why, "take the object away, release, and clear")
    return state, replace(observation, fault=lost) if observation.fault is None else replace(
        observation, also=(*observation.also, lost)
    )


def _loss(observation: Observation) -> str | None:
    gripper = observation.gripper
    if gripper is not None and gripper.closed_on_nothing:
        return "the gripper closed on nothing while holding"
    if gripper is not None and not gripper.holding and not gripper.moving:
        return "the gripper no longer holds anything"
    if observation.fused is not None and observation.fused.none_touches:
        return "no finger sees contact any more"
    return None


def _in_doubt(observation: Observation) -> bool:
    """Whether a loss rests on one finger's word alone."""
    fused, gripper = observation.fused, observation.gripper
    if gripper is not None and not gripper.holding:
        return False
    return fused is not None and (fused.left_contact is None or fused.right_contact is None)


def _latch(state: GraspState, observation: Observation, fault: Fault, command: Command) -> Outcome:
    """Into FAULT: keep the grip, stop the arm, say so."""
    state = replace(entered(state, Phase.FAULT, observation.now_s), fault=fault, arm_sent_s=observation.now_s)
    command = replace(command, arm="stop", fault=fault, say=in_one_line(command.say, str(fault)))
    return _tell_besides(replace(state, besides=frozenset({fault.code})), observation, command)


# --- phases ---


def _idle(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """Nothing is held, or something that slipguard is not to guard."""
    gripper = observation.gripper
    if gripper is None:
        return state, Command()
    if gripper.holding and not state.adopted:
        return adopting.adopt(state, gripper, observation, params)
    if adopting.undecided(state, gripper):
        return state, Command()
    state = replace(state, adopted=True, remembered=None)
    touched = observation.fused is not None and observation.fused.both_touch
    if params.mode == "guard" and state.guarding and gripper.holding and touched and not state.closing_interrupted:
        said = f"an object is held with {gripper.force_n:.0f} N: guarding"
        return taken_over(state, gripper, observation.now_s), Command(new_reference=True, say=said)
    return state, Command()


def _closing(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """The jaws close with the first force."""
    gripper = observation.gripper
    state = replace(state, delay=delay.closing(state.delay, state.commanded_s, gripper))
    if gripper is not None and gripper.measured_at_s > state.since_s:
        if gripper.holding and not gripper.moving and gripper.force_n > 0.0:  # 0: halted by an earlier stop
            state = replace(entered(state, Phase.REFERENCE, observation.now_s), gripped=True)
            return state, Command(new_reference=True, say="gripped")
        if gripper.closed_on_nothing:
            return emptied(state, Phase.IDLE, observation.now_s), Command(say="the gripper closed on nothing")
    if observation.now_s - state.since_s > params.tuning.closing_timeout_s:
        fault = Fault(
            FaultCode.GRIPPER_STUCK,
            f"not closed on an object within {params.tuning.closing_timeout_s:g} s",
            "look at the jaws and the gripper's cable, then clear",
        )
        return _latch(state, observation, fault, Command())
    return state, Command()


def _reference(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """Wait until both fingers have their reference; after the time-out one will do, or none with a firmer grip."""
    fused = observation.fused
    waited = observation.now_s - state.since_s > params.tuning.reference_timeout_s
    told = fused is not None and fused.rotation_deg is not None and fused.measured_at_s >= state.since_s
    if fused is not None and told and (waited or len(fused.fingers) == 2):
        note = f" by one finger only ({fused.note})" if len(fused.fingers) == 1 else ""
        state = replace(entered(state, Phase.HOLDING, observation.now_s), referenced=True, blind=None)
        return state, Command(say=f"holding with {state.target_n:.0f} N, turn seen{note}")
    if not waited:
        return state, Command()
    why = (fused.declined if fused is not None else None) or "no frames from either finger"
    state = replace(entered(state, Phase.HOLDING, observation.now_s), referenced=False, blind=why)
    if params.on_no_estimate == "refuse" or not state.guarding:
        return state, Command(say=f"the turn cannot be seen ({why})")
    within = limits.budget(params.force_max_n, observation.gripper_limits_n)
    target_n = limits.allowed(params.no_estimate_force_n, state.target_n, within) if within is not None else 0.0
    said = f"the turn cannot be seen ({why}): gripping with {max(target_n, state.target_n):.0f} N"
    if target_n <= state.target_n or state.person_near:
        return state, Command(say=said)
    state = replace(state, target_n=target_n, commanded_s=observation.now_s)
    return state, Command(hold_force_n=target_n, say=said)


def _holding(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """Guard; the arm is somebody else's or at rest, and is stopped while the object slips."""
    return _guarded(state, observation, params)


def _moving(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """Lift or lower, leg by leg; stop while the object slips and go on when it is calm."""
    state, command = _guarded(state, observation, params)
    arm = observation.arm
    if state.phase is Phase.FAULT or arm is None or state.goal_mm is None or state.slip is not None:
        return state, command
    if state.lost_since_s is not None:
        return state, command
    if not motion.ended(state, arm, observation.now_s):
        return state, command
    way_mm = state.goal_mm - arm.height_mm
    if abs(way_mm) <= REACHED_MM:
        state = entered(state, Phase.HOLDING, observation.now_s)
        return state, replace(command, say=in_one_line(command.say, f"at {arm.height_mm:.0f} mm, holding"))
    said = "the arm goes on" if state.paused else None
    state = replace(state, paused=False, arm_sent_s=observation.now_s)
    leg = requests.next_leg(state, arm.height_mm, params)
    return state, replace(command, arm=leg, say=in_one_line(command.say, said))


def _guarded(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    verdict = guard(state, observation, params)
    state, command = verdict.state, Command(hold_force_n=verdict.hold_n, say=verdict.say, warn=verdict.stop)
    if verdict.fault is not None:
        return motion.put_down(_latch(state, observation, verdict.fault, command), observation, params)
    perhaps_lost = (
        state.lost_since_s is not None and observation.now_s - state.lost_since_s >= params.tuning.lost_after_s
    )
    if (verdict.stop and params.stop_on_slip) or perhaps_lost:
        first = state.slip is not None and state.slip.began_s == observation.now_s
        state, command = motion.stop(replace(state, paused=True), observation, command, at_once=first)
    return state, command


def _released(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """Opening as asked; said again if nothing happens, given up after `stuck_s`."""
    state, command, fault = release.go_on(state, observation, params)
    return (state, command) if fault is None else _latch(state, observation, fault, command)


def _faulty(state: GraspState, observation: Observation, params: GuardParams) -> Outcome:
    """The arm stands and the grip is kept; slip is still answered with force where that is allowed and possible."""
    state, found = adopting.adopt_in_fault(state, observation, params)
    verdict = guard(state, observation, params) if not state.hands_off else GuardResult(state)
    said = in_one_line(found, verdict.say)
    state, command = verdict.state, Command(hold_force_n=verdict.hold_n, say=said, warn=verdict.stop)
    state, command = _tell_besides(state, observation, command, verdict.fault)
    if observation.gripper is not None and observation.gripper.holding and not state.gripped and not state.hands_off:
        state = replace(state, gripped=True)
    if state.putting_down:
        return motion.go_on_down(state, observation, command, params)
    return motion.stop(state, observation, command)


def _tell_besides(state: GraspState, observation: Observation, command: Command, found: Fault | None = None) -> Outcome:
    """Say what else goes wrong while a fault is latched, once for each time."""
    wrong = {fault.code: fault for fault in (observation.fault, *observation.also, found) if fault is not None}
    new = [str(fault) for code, fault in wrong.items() if code not in state.besides]
    command = replace(command, say=in_one_line(command.say, *new), warn=command.warn or bool(new))
    return replace(state, besides=frozenset(wrong)), command


_PHASES: dict[Phase, Callable[[GraspState, Observation, GuardParams], Outcome]] = {
    Phase.IDLE: _idle,
    Phase.CLOSING: _closing,
    Phase.REFERENCE: _reference,
    Phase.LIFTING: _moving,
    Phase.HOLDING: _holding,
    Phase.LOWERING: _moving,
    Phase.RELEASED: _released,
    Phase.FAULT: _faulty,
}


# --- in every phase ---


def _keep_force(state: GraspState, observation: Observation, command: Command) -> Outcome:
    """Say the force again if the gripper did not take it: a lost message must not leave the grip weak."""
    gripper = observation.gripper
    held = (state.phase in AT_STAKE or state.phase is Phase.FAULT) and not state.hands_off
    if not held or gripper is None or state.person_near or command.hold_force_n is not None:
        return state, command
    if state.commanded_s == -math.inf:
        return state, command  # a grip that was taken over is left as it is
    closing = state.phase is Phase.CLOSING
    weak = gripper.force_n < state.target_n - FORCE_TOLERANCE_N and (gripper.holding or closing)
    known = gripper.measured_at_s > state.commanded_s and observation.now_s - state.commanded_s >= REPEAT_S
    if not (weak and known):
        return state, command
    return replace(state, commanded_s=observation.now_s), replace(command, hold_force_n=state.target_n)


def _tell_notes(state: GraspState, observation: Observation, command: Command) -> Outcome:
    """Say once that a finger is blind or that the two contradict each other, and when that is over."""
    fused = observation.fused
    if not (state.phase in SPOKEN_OF or (state.phase is Phase.FAULT and state.gripped)):
        return (state if state.note is None else replace(state, note=None)), command
    if fused is None:
        return state, command
    note = fused.conflict or fused.note or fused.declined
    if note is not None:
        if state.note is not None and without_figures(state.note) == without_figures(note):
            return replace(state, noted_s=observation.now_s), command
        return replace(state, note=note, noted_s=observation.now_s), replace(
            command, say=in_one_line(command.say, note)
        )
    if state.note is None or observation.now_s - state.noted_s < NOTE_OVER_S:
        return state, command
    return replace(state, note=None), replace(command, say=in_one_line(command.say, f"no longer: {state.note}"))
