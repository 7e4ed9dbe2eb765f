"""The second pair of eyes: is everything the law relies on still there, and does tightening help?

Separate from the law on purpose: it looks at the same inputs, decides nothing about force, and only says what is wrong
now. The law latches what it says. A fault that has passed is no longer said, so that it can be cleared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control.fault import Fault, FaultCode
from slipguard.control.messages import Condition, FingerHealth, Observation
from slipguard.control.params import GuardParams
from slipguard.control.state import AT_STAKE, MOVING, GraspState, Phase, waiting

HELP_DEG = 5.0
"""An object that has turned this much further after it was tightened, and still turns, is not helped."""
ARM_WAIT_S = 5.0
"""An arm not yet heard since the start may take so long to appear; a UR's control program starts within 2 s."""
FIRST_WAIT_S = 2.0
"""Sensors and gripper not yet heard may take so long from the start, or their time-out where that is longer."""
MOMENT_S = 0.6
"""A contradiction is not settled by one finger saying nothing for so long: one left out is asked again each 0.25 s."""
GAIN_MM = 1.0
"""Less height than this gained counts as none."""


@dataclass(frozen=True, slots=True)
class Supervision:
    """What the supervisor remembers. Times are None while all is well.

    began_s: the first tick. arm_known, gripper_known, frames_known: heard since then. untrusted, untrusted_since_s:
    why the turn cannot be believed, and since when; contradicted_s: when the fingers contradicted each other last.
    help_rotation_deg, help_since_s: the first tightening of the present episode. mark_mm, mark_s: last progress of the
    arm, while it should move.
    """

    began_s: float = -math.inf
    tick_s: float | None = None
    frames_since_s: float | None = None
    untrusted: str | None = None
    untrusted_since_s: float | None = None
    contradicted_s: float = -math.inf
    gripper_since_s: float | None = None
    arm_since_s: float | None = None
    arm_known: bool = False
    gripper_known: bool = False
    frames_known: bool = False
    help_rotation_deg: float | None = None
    help_since_s: float | None = None
    mark_mm: float | None = None
    mark_s: float = 0.0


def watch(
    memory: Supervision, state: GraspState, observation: Observation, params: GuardParams
) -> tuple[Supervision, tuple[Fault, ...]]:
    """What is wrong now, the gravest first; nothing while nothing is at stake.

    While what was held before a restart is still to be found, only what would find it is looked at.
    """
    now_s = observation.now_s
    late_s = now_s - memory.tick_s if memory.tick_s is not None else 0.0
    known = Supervision(
        began_s=now_s if memory.tick_s is None else memory.began_s,
        tick_s=now_s,
        arm_known=memory.arm_known or observation.arm is not None,
        gripper_known=memory.gripper_known or observation.gripper is not None,
        frames_known=memory.frames_known or math.isfinite(min(observation.left.age_s, observation.right.age_s)),
    )
    held = state.phase in AT_STAKE or state.phase is Phase.FAULT
    if not held and not waiting(state):
        return known, ()
    memory = replace(
        memory,
        began_s=known.began_s,
        tick_s=now_s,
        arm_known=known.arm_known,
        gripper_known=known.gripper_known,
        frames_known=known.frames_known,
        frames_since_s=_since(memory.frames_since_s, _no_frames(observation, params), now_s),
        gripper_since_s=_since(memory.gripper_since_s, observation.gripper is None, now_s),
        arm_since_s=_since(memory.arm_since_s, observation.arm is None, now_s),
    )
    finders = _gripper(memory, observation, params), _frames(memory, observation, params)
    if not held:
        return memory, tuple(fault for fault in finders if fault is not None)
    memory = _follow_trust(memory, state, observation)
    memory = _follow_help(memory, state, observation)
    memory = _follow_arm(memory, state, observation)
    checks = (
        _arm_stop(observation),
        *finders,
        _arm(memory, state, observation, params),
        _arm_stuck(memory, state, observation, params),
        _no_help(memory, observation, params),
        _trust(memory, state, observation, params),
        _late(late_s, params),
    )
    return memory, tuple(fault for fault in checks if fault is not None)


def _since(since_s: float | None, wrong: bool, now_s: float) -> float | None:
    """When it went wrong; None if it is not."""
    if not wrong:
        return None
    return now_s if since_s is None else since_s


def _lasts(since_s: float | None, now_s: float, limit_s: float) -> bool:
    return since_s is not None and now_s - since_s >= limit_s


def _silent_s(measured_at_s: float | None, since_s: float | None, now_s: float) -> float:
    """How long a device has said nothing."""
    if measured_at_s is not None:
        return now_s - measured_at_s
    return now_s - since_s if since_s is not None else 0.0


def _starts(memory: Supervision, known: bool, now_s: float, timeout_s: float) -> bool:
    """A device that has said nothing yet still has the time to appear."""
    return not known and now_s - memory.began_s < max(timeout_s, FIRST_WAIT_S)


def _arm_stop(observation: Observation) -> Fault | None:
    if observation.arm is None or not (observation.arm.emergency_stop or observation.arm.protective_stop):
        return None
    code = FaultCode.ARM_EMERGENCY if observation.arm.emergency_stop else FaultCode.ARM_STOPPED
    return Fault(
        code,
        f"the arm stopped itself at {observation.arm.height_mm:.0f} mm",
        "see why, end the stop at the robot's panel, then clear; no force is added meanwhile",
    )


def _gripper(memory: Supervision, observation: Observation, params: GuardParams) -> Fault | None:
    gripper = observation.gripper
    silent_s = _silent_s(gripper.measured_at_s if gripper else None, memory.gripper_since_s, observation.now_s)
    starts = _starts(memory, memory.gripper_known, observation.now_s, params.tuning.gripper_timeout_s)
    if silent_s >= params.tuning.gripper_timeout_s and not starts:
        return Fault(
            FaultCode.GRIPPER_SILENT,
            f"no answer for {silent_s:.1f} s",
            "check its cable and power; the fingers lock themselves and keep the grip; then clear",
        )
    if gripper is not None and (gripper.fault is not None or not gripper.active):
        return Fault(
            FaultCode.GRIPPER_FAULT,
            f"the gripper says: {gripper.fault or 'not activated'}",
            "support the object before the gripper is reset: activating opens it",
        )
    return None


def _no_frames(observation: Observation, params: GuardParams) -> bool:
    return all(_blind(finger, params) for finger in (observation.left, observation.right))


def _blind(finger: FingerHealth, params: GuardParams) -> bool:
    return finger.condition is not Condition.FRESH or finger.age_s >= params.tuning.frames_timeout_s


def _frames(memory: Supervision, observation: Observation, params: GuardParams) -> Fault | None:
    if memory.frames_since_s is None:
        return None
    silent_s = max(min(observation.left.age_s, observation.right.age_s), observation.now_s - memory.frames_since_s)
    starts = _starts(memory, memory.frames_known, observation.now_s, params.tuning.frames_timeout_s)
    if silent_s < params.tuning.frames_timeout_s or starts:
        return None
    both = " and ".join(
        f"{name}: {finger.why or finger.condition}"
        for name, finger in (("left", observation.left), ("right", observation.right))
    )
    return Fault(
        FaultCode.FRAMES_LOST,
        f"no good frame for {silent_s:.1f} s ({both})" if math.isfinite(silent_s) else f"never a good frame ({both})",
        "check the sensors' cables, then clear; until then nobody sees a slip",
    )


def _follow_trust(memory: Supervision, state: GraspState, observation: Observation) -> Supervision:
    """Why the turn cannot be believed though it could be read when the object was gripped, and since when."""
    fused = observation.fused
    if fused is None or not state.referenced or state.phase is Phase.REFERENCE:
        return replace(memory, untrusted=None, untrusted_since_s=None)
    why = fused.conflict if fused.conflict is not None or fused.rotation_deg is not None else fused.declined
    contradicted_s = memory.contradicted_s if fused.conflict is None else observation.now_s
    if why is None and len(fused.fingers) == 1 and observation.now_s - contradicted_s < MOMENT_S:
        why = memory.untrusted
    since_s = _since(memory.untrusted_since_s, why is not None, observation.now_s)
    return replace(memory, untrusted=why, untrusted_since_s=since_s, contradicted_s=contradicted_s)


def _trust(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Fault | None:
    if not state.guarding or not _lasts(memory.untrusted_since_s, observation.now_s, params.tuning.estimate_timeout_s):
        return None
    return Fault(
        FaultCode.ESTIMATE_UNTRUSTED,
        f"for {params.tuning.estimate_timeout_s:g} s: {memory.untrusted}",
        "look at both fingers; clear takes a new reference, release lets go",
    )


def _arm(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Fault | None:
    silent_s = _silent_s(
        observation.arm.measured_at_s if observation.arm else None, memory.arm_since_s, observation.now_s
    )
    gone_on_the_way = observation.arm is None and (state.phase in MOVING or state.putting_down)
    limit_s = params.tuning.arm_timeout_s if memory.arm_known else ARM_WAIT_S
    if silent_s < limit_s and not gone_on_the_way:
        return None
    return Fault(
        FaultCode.ARM_SILENT,
        f"no state for {silent_s:.1f} s",
        "check the robot's network and power; stop it by hand if it moves; then clear",
    )


def _follow_arm(memory: Supervision, state: GraspState, observation: Observation) -> Supervision:
    """Mark each millimetre the arm gains while it should be moving."""
    goes = state.putting_down or (state.phase in MOVING and state.slip is None)
    if not goes or observation.arm is None:
        return memory if memory.mark_mm is None else replace(memory, mark_mm=None)
    if memory.mark_mm is None or abs(observation.arm.height_mm - memory.mark_mm) >= GAIN_MM:
        return replace(memory, mark_mm=observation.arm.height_mm, mark_s=observation.now_s)
    return memory


def _arm_stuck(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Fault | None:
    if (
        memory.mark_mm is None
        or observation.arm is None
        or observation.now_s - memory.mark_s < params.tuning.stuck_timeout_s
    ):
        return None
    return Fault(
        FaultCode.ARM_STUCK,
        f"at {observation.arm.height_mm:.0f} mm for {params.tuning.stuck_timeout_s:g} s on the way to {state.goal_mm or 0.0:.0f} mm",
        "see what stops the arm (its limits, its program, an obstacle), then clear",
    )


def _follow_help(memory: Supervision, state: GraspState, observation: Observation) -> Supervision:
    """Mark where the object stood when it was first tightened."""
    rotation_deg = observation.fused.rotation_deg if observation.fused is not None else None
    if state.slip is None:
        return memory if memory.help_since_s is None else replace(memory, help_rotation_deg=None, help_since_s=None)
    if memory.help_rotation_deg is None and rotation_deg is not None:
        return replace(memory, help_rotation_deg=rotation_deg, help_since_s=observation.now_s)
    return memory


def _no_help(memory: Supervision, observation: Observation, params: GuardParams) -> Fault | None:
    fused = observation.fused
    if fused is None or fused.rotation_deg is None or memory.help_rotation_deg is None:
        return None
    further_deg = fused.rotation_deg - memory.help_rotation_deg
    outward_deg_s = (fused.rate_deg_s or 0.0) * (1.0 if further_deg > 0.0 else -1.0)
    if not _lasts(memory.help_since_s, observation.now_s, params.tuning.tighten_effect_timeout_s):
        return None
    if abs(further_deg) < HELP_DEG or outward_deg_s < params.tuning.slip_rate_deg_s:
        return None
    return Fault(
        FaultCode.NO_HELP,
        f"{abs(further_deg):.0f}° further and still turning at {outward_deg_s:.0f}°/s "
        f"{params.tuning.tighten_effect_timeout_s:g} s after tightening",
        "support the object; grip it nearer to its centre of mass",
    )


def _late(late_s: float, params: GuardParams) -> Fault | None:
    if late_s < params.tuning.cycle_timeout_s:
        return None
    return Fault(
        FaultCode.LOOP_LATE,
        f"nothing was decided for {late_s:.2f} s",
        "see what keeps the machine busy, then clear",
    )
