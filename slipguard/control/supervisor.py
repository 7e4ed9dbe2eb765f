"""Check separately that everything the controller relies on is still there, and that tightening has an effect.

The supervisor sees the same inputs as the controller, decides nothing about force, and only reports what is wrong now.
The controller latches what it reports. A fault that has passed is no longer reported, so that it can be cleared.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control.messages import Condition, FingerHealth, Observation
from slipguard.control.object_presence import CHECK_IMAGES
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import AT_STAKE, MOVING, GraspState, Phase

NO_EFFECT_DEG = 5.0
"""Tightening has no effect if the object has rotated this much further after it, and still rotates."""
ARM_START_S = 5.0
"""An arm that has not reported since the start gets this time; a UR's control program starts within 2 s."""
DEVICE_START_S = 2.0
"""Sensors and gripper that have not reported since the start get this time, or their timeout if that is longer."""
LEFT_OUT_S = 0.6
"""If one finger stops giving estimates, a contradiction stays in force this long.

A skipped finger is measured again every 0.25 s, so its silence is no agreement."""
BUSY_SHARE = 0.5
"""A device's silence is due to the busy machine if the loop was late for this share of the device's timeout."""
GAIN_MM = 1.0
"""Less height than this gained counts as none."""


@dataclass(frozen=True, slots=True)
class Supervision:
    """What the supervisor remembers. Times are None while all is well.

    Args:
        began_s, stepped_s: the first and the newest step.
        arm_known, gripper_known, frames_known: received since then.
        resumed_s: time of the first step after the loop last stood still for `cycle_timeout_s`.
        frames_since_s, gripper_since_s, arm_since_s: since when they are missing.
        untrusted, untrusted_since_s: why the rotation estimate cannot be trusted, and since when.
        contradicted_s: when the fingers last contradicted each other.
        tightened_deg, tightened_since_s: rotation at the first tightening of the present episode, and since when.
        gained_mm, gained_s: last progress of the arm, while it should move.
    """

    began_s: float = -math.inf
    stepped_s: float | None = None
    arm_known: bool = False
    gripper_known: bool = False
    frames_known: bool = False
    resumed_s: float = -math.inf
    frames_since_s: float | None = None
    gripper_since_s: float | None = None
    arm_since_s: float | None = None
    untrusted: str | None = None
    untrusted_since_s: float | None = None
    contradicted_s: float = -math.inf
    tightened_deg: float | None = None
    tightened_since_s: float | None = None
    gained_mm: float | None = None
    gained_s: float = 0.0


def supervise(
    memory: Supervision, state: GraspState, observation: Observation, params: GuardParams
) -> tuple[Supervision, tuple[Fault, ...]]:
    """Return the memory and what is wrong now, the gravest first; nothing while nothing is at stake.

    While what was held before a restart is still to be found, only gripper and fingers are checked.
    """
    now_s = observation.now_s
    late_s = now_s - memory.stepped_s if memory.stepped_s is not None else 0.0
    began_s = now_s if memory.stepped_s is None else memory.began_s
    arm_known = memory.arm_known or observation.arm is not None
    gripper_known = memory.gripper_known or observation.gripper is not None
    youngest_s = min(observation.left.age_s, observation.right.age_s)
    frames_known = memory.frames_known or math.isfinite(youngest_s)
    held = state.phase in AT_STAKE or state.phase is Phase.FAULT
    if not held and not state.waits_for_gripper:
        return Supervision(began_s, now_s, arm_known, gripper_known, frames_known), ()
    memory = replace(
        memory,
        began_s=began_s,
        stepped_s=now_s,
        resumed_s=now_s if late_s >= params.tuning.cycle_timeout_s else memory.resumed_s,
        arm_known=arm_known,
        gripper_known=gripper_known,
        frames_known=frames_known,
        frames_since_s=_since(memory.frames_since_s, _no_frames(observation, params), now_s),
        gripper_since_s=_since(memory.gripper_since_s, observation.gripper is None, now_s),
        arm_since_s=_since(memory.arm_since_s, observation.arm is None, now_s),
    )
    devices = _gripper(memory, observation, params), _frames(memory, observation, params)
    if not held:
        return memory, _merge_busy(devices)
    memory = _follow_trust(memory, state, observation, params)
    memory = _follow_tightening(memory, state, observation)
    memory = _follow_arm(memory, state, observation)
    checks = (
        _arm_stop(state, observation),
        _late(late_s, params),
        *devices,
        _arm(memory, state, observation, params),
        _arm_stuck(memory, state, observation, params),
        _no_effect(memory, observation, params),
        _untrusted(memory, state, observation, params),
    )
    return memory, _merge_busy(checks)


def _merge_busy(checks: tuple[Fault | None, ...]) -> tuple[Fault, ...]:
    """Return the faults; of several that are due to the busy machine, the first."""
    faults = [fault for fault in checks if fault is not None]
    busy = [fault for fault in faults if fault.code is FaultCode.MACHINE_BUSY]
    return tuple(fault for fault in faults if fault not in busy[1:])


def _due_to_busy_machine(fault: Fault, observation: Observation, timeout_s: float, *, connected: bool) -> Fault:
    """Return the fault of a silent device; if this machine was too busy to read it, the fault of the machine.

    connected: whether the driver still has its device.
    """
    if not connected or observation.busy_s < BUSY_SHARE * timeout_s:
        return fault
    late = f"the control loop was late for {observation.busy_s:.2f} s of the last second"
    return _busy(f"{fault.code}: {fault.observed}; {late}")


def _busy(observed: str) -> Fault:
    return Fault(FaultCode.MACHINE_BUSY, observed, "find what keeps the machine busy, then clear")


def _since(since_s: float | None, wrong: bool, now_s: float) -> float | None:
    """Return since when it is wrong; None if it is not."""
    if not wrong:
        return None
    return now_s if since_s is None else since_s


def _lasts(since_s: float | None, now_s: float, limit_s: float) -> bool:
    return since_s is not None and now_s - since_s >= limit_s


def _silent_s(memory: Supervision, measured_at_s: float | None, since_s: float | None, now_s: float) -> float:
    """Return for how long a device has not reported. While the loop itself stood still, no device could report."""
    known_s = measured_at_s if measured_at_s is not None else since_s
    return 0.0 if known_s is None else now_s - max(known_s, memory.resumed_s)


def _starts(memory: Supervision, known: bool, now_s: float, timeout_s: float) -> bool:
    """Return whether a device that has not reported yet still has time to do so."""
    return not known and now_s - memory.began_s < max(timeout_s, DEVICE_START_S)


def _arm_stop(state: GraspState, observation: Observation) -> Fault | None:
    arm, ground_mm = observation.arm, state.arm.ground_mm
    if arm is None or not (arm.emergency_stop or arm.protective_stop):
        return None
    where = "" if ground_mm is None else f" {arm.height_mm - ground_mm:.0f} mm above the start of the lift"
    return Fault(
        FaultCode.ARM_EMERGENCY if arm.emergency_stop else FaultCode.ARM_STOPPED,
        f"the arm stopped itself{where}",
        "find the cause, end the stop at the robot's panel, then clear; until then no force is added",
    )


def _gripper(memory: Supervision, observation: Observation, params: GuardParams) -> Fault | None:
    gripper, now_s, timeout_s = observation.gripper, observation.now_s, params.tuning.gripper_timeout_s
    silent_s = _silent_s(memory, gripper.measured_at_s if gripper else None, memory.gripper_since_s, now_s)
    if silent_s >= timeout_s and not _starts(memory, memory.gripper_known, now_s, timeout_s):
        silent = Fault(
            FaultCode.GRIPPER_SILENT,
            f"no response for {silent_s:.1f} s",
            "check its cable and power; the jaws lock themselves and keep the grip; then clear",
        )
        return _due_to_busy_machine(silent, observation, timeout_s, connected=gripper is not None)
    if gripper is not None and (gripper.fault is not None or not gripper.active):
        return Fault(
            FaultCode.GRIPPER_FAULT,
            f"the gripper reports: {gripper.fault or 'not activated'}",
            "support the object, then release: the jaws open slowly, and do not close",
        )
    return None


def _no_frames(observation: Observation, params: GuardParams) -> bool:
    return all(_is_old(finger, params) for finger in (observation.left, observation.right))


def _is_old(finger: FingerHealth, params: GuardParams) -> bool:
    return finger.condition is not Condition.FRESH or finger.age_s >= params.tuning.frames_timeout_s


def _frames(memory: Supervision, observation: Observation, params: GuardParams) -> Fault | None:
    now_s, timeout_s = observation.now_s, params.tuning.frames_timeout_s
    if memory.frames_since_s is None:
        return None
    fingers = (("left", observation.left), ("right", observation.right))
    silent_s = max(min(finger.age_s for _, finger in fingers), now_s - memory.frames_since_s)
    silent_s = min(silent_s, now_s - memory.resumed_s)
    if silent_s < timeout_s or _starts(memory, memory.frames_known, now_s, timeout_s):
        return None
    both = " and ".join(f"{name}: {finger.why or finger.condition}" for name, finger in fingers)
    if any(finger.condition is Condition.BLIND for _, finger in fingers):
        return Fault(FaultCode.FINGERS_BLIND, f"for {silent_s:.1f} s no finger sees ({both})", CHECK_IMAGES)
    if any(finger.condition is Condition.LATE for _, finger in fingers):
        return _busy(f"frames arrive, but are processed {silent_s:.1f} s late ({both})")
    if any(finger.condition is Condition.STUCK for _, finger in fingers):
        stuck = f"frames arrive, but their processing does not return ({both})"
        fault = Fault(
            FaultCode.FRAMES_LOST, stuck, "restart slipguard, which keeps the grip; until then slip is not detected"
        )
        return _due_to_busy_machine(fault, observation, timeout_s, connected=True)
    lost = Fault(
        FaultCode.FRAMES_LOST,
        f"no good frame for {silent_s:.1f} s ({both})" if math.isfinite(silent_s) else f"never a good frame ({both})",
        "remove that cause, check the sensors' cables, then clear; until then slip is not detected",
    )
    connected = any(finger.condition is not Condition.LOST for _, finger in fingers)
    return _due_to_busy_machine(lost, observation, timeout_s, connected=connected)


def _follow_trust(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Supervision:
    """Note why there is no rotation that can be trusted, and since when, if there was one after the grip.

    A firmer grip moves an imprint, that of a wedge by 1.2 mm in a grip 30 % firmer. So shifts that contradict each
    other after a tightening do not count.
    """
    fused, now_s = observation.fused, observation.now_s
    if fused is None or not state.held.referenced or state.phase is Phase.REFERENCE or _no_frames(observation, params):
        return replace(memory, untrusted=None, untrusted_since_s=None)
    conflict = fused.conflict or (None if state.held.load.tightened else fused.shift_conflict)
    why = conflict if conflict is not None or fused.rotation_deg is not None else fused.declined
    contradicted_s = memory.contradicted_s if conflict is None else now_s
    if why is None and len(fused.fingers) == 1 and now_s - contradicted_s < LEFT_OUT_S:
        why = memory.untrusted
    since_s = _since(memory.untrusted_since_s, why is not None, now_s)
    return replace(memory, untrusted=why, untrusted_since_s=since_s, contradicted_s=contradicted_s)


def _untrusted(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Fault | None:
    timeout_s = params.tuning.estimate_timeout_s
    if not state.guarding or not _lasts(memory.untrusted_since_s, observation.now_s, timeout_s):
        return None
    return Fault(
        FaultCode.ESTIMATE_UNTRUSTED,
        f"for {timeout_s:g} s: {memory.untrusted}",
        "check both fingers, then clear, which takes a new reference",
    )


def _arm(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Fault | None:
    arm = observation.arm
    silent_s = _silent_s(memory, arm.measured_at_s if arm else None, memory.arm_since_s, observation.now_s)
    gone_in_motion = arm is None and (state.phase in MOVING or state.arm.putting_down)
    limit_s = params.tuning.arm_timeout_s if memory.arm_known else ARM_START_S
    if silent_s < limit_s and not gone_in_motion:
        return None
    silent = Fault(
        FaultCode.ARM_SILENT,
        f"no state for {silent_s:.1f} s",
        "check the robot's network and power; stop it by hand if it moves; then clear",
    )
    return _due_to_busy_machine(silent, observation, limit_s, connected=arm is not None)


def _follow_arm(memory: Supervision, state: GraspState, observation: Observation) -> Supervision:
    """Follow each millimeter the arm gains while it should be moving."""
    arm = observation.arm
    goes = state.arm.putting_down or (state.phase in MOVING and state.held.slip is None)
    if not goes or arm is None:
        return replace(memory, gained_mm=None)
    if memory.gained_mm is None or abs(arm.height_mm - memory.gained_mm) >= GAIN_MM:
        return replace(memory, gained_mm=arm.height_mm, gained_s=observation.now_s)
    return memory


def _arm_stuck(memory: Supervision, state: GraspState, observation: Observation, params: GuardParams) -> Fault | None:
    arm, timeout_s = observation.arm, params.tuning.stuck_timeout_s
    if memory.gained_mm is None or arm is None:
        return None
    if observation.now_s - max(memory.gained_s, memory.resumed_s) < timeout_s:
        return None
    return Fault(
        FaultCode.ARM_STUCK,
        f"at {arm.height_mm:.0f} mm for {timeout_s:g} s on the way to {state.arm.goal_mm or 0.0:.0f} mm",
        "find what stops the arm (its limits, its program, an obstacle), then clear",
    )


def _follow_tightening(memory: Supervision, state: GraspState, observation: Observation) -> Supervision:
    """Note the rotation at the first tightening of an episode."""
    rotation_deg = observation.fused.rotation_deg if observation.fused is not None else None
    if state.held.slip is None:
        return replace(memory, tightened_deg=None, tightened_since_s=None)
    if memory.tightened_deg is None and rotation_deg is not None:
        return replace(memory, tightened_deg=rotation_deg, tightened_since_s=observation.now_s)
    return memory


def _no_effect(memory: Supervision, observation: Observation, params: GuardParams) -> Fault | None:
    fused, timeout_s = observation.fused, params.tuning.tighten_effect_timeout_s
    if fused is None or fused.rotation_deg is None or memory.tightened_deg is None:
        return None
    further_deg = fused.rotation_deg - memory.tightened_deg
    outward_deg_s = (fused.rate_deg_s or 0.0) * (1.0 if further_deg > 0.0 else -1.0)
    if not _lasts(memory.tightened_since_s, observation.now_s, timeout_s):
        return None
    if abs(further_deg) < NO_EFFECT_DEG or outward_deg_s < params.tuning.slip_rate_deg_s:
        return None
    return Fault(
        FaultCode.TIGHTENING_INEFFECTIVE,
        f"{abs(further_deg):.0f}° further and still rotating at {outward_deg_s:.0f}°/s "
        f"{timeout_s:g} s after tightening",
        "support the object; grip it nearer to its center of mass",
    )


def _late(late_s: float, params: GuardParams) -> Fault | None:
    if late_s < params.tuning.cycle_timeout_s:
        return None
    return Fault(
        FaultCode.LOOP_LATE,
        f"no control step for {late_s:.2f} s (limit {params.tuning.cycle_timeout_s:g} s)",
        "find what keeps the machine busy, then clear",
    )
