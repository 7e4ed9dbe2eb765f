"""What the slip detector remembers of a held object, and how each new estimate updates it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from enum import Enum

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import (
    SWITCH_SHIFT_MM,
    Baselines,
    FingerSwitch,
    ReportingFingers,
    ShiftFilter,
    plus,
    within,
)
from slipguard.devices import ArmState

SAME_DEG = 1e-6
"""Baselines no further apart than this are equal: rounding."""
SECOND_FRAME_S = 0.1
"""A later frame does not confirm the offset of a finger switch: the object may have rotated."""
ARM_SETTLE_S = 0.4
"""After the arm has come to rest the gel still swings for this time."""
LIFT_OFF_MM = 80.0
"""An arm that has risen by less since the grip may still be lifting the object off its table: the far end of an object
held 200 mm from it stays down up to 70 mm on a gel that twists elastically by 20 degrees."""
FOLLOW_S = 3.0
"""At rest the resting angle follows the estimate with this time constant: light drifts, slip is faster."""
NOISE_FRAMES = 30.0
"""The noise is learned over this many frames."""
NOISE_START_DEG = 0.06
NOISE_MAX_DEG = 0.5
NOISE_TIMES = 6.0
"""A rotation of this many standard deviations of the noise at rest is not noise."""
HANGS_MM, HANGS_DEG = 12.0, 0.3
"""An object that rotates by no more than this over this further height hangs free: one whose far end is still on the
table rotates by 0.7 degrees even if that is 1 m away."""
STEADY_DEG_S = 3.0
"""A frame with a faster rotation is no resting angle: the rotation goes on, or a frame leapt."""


class ArmCase(Enum):
    """Which rotations are to be expected from what the arm does."""

    REST = "at rest"
    LIFT_OFF = "lifting off"
    MOVING = "moving"


@dataclass(frozen=True, slots=True)
class ArmContext:
    """What the arm has done since the grip.

    Args:
        start_mm: its lowest height. moved_s: when it last moved.
        case: which rotations are to be expected now.
        aloft: the object has left the table since it was gripped or put down.
        level_mm, level_deg: the height up to which the object rotated, and its rotation there. hangs: the arm has since
            risen so far without rotating it that it hangs free.
    """

    start_mm: float | None = None
    moved_s: float = -math.inf
    case: ArmCase = ArmCase.MOVING
    aloft: bool = False
    level_mm: float = math.inf
    level_deg: float = 0.0
    hangs: bool = False

    def next(self, fused: FusedEstimate, arm: ArmState | None, *, putting_down: bool) -> ArmContext:
        """Return the context after one more state of the arm. Without an arm the load may change at any time."""
        start_mm, moved_s = self.start_mm, self.moved_s
        if arm is not None:
            start_mm = arm.height_mm if start_mm is None else min(start_mm, arm.height_mm)
            moved_s = arm.measured_at_s if arm.moving else moved_s
        case = ArmCase.MOVING
        if arm is not None and arm.motion_known and start_mm is not None:
            if not arm.moving and fused.captured_at_s - moved_s > ARM_SETTLE_S:
                case = ArmCase.REST
            elif arm.height_mm - start_mm < LIFT_OFF_MM:
                case = ArmCase.LIFT_OFF
        aloft = (self.aloft or self.leaves_table(case)) and not putting_down
        level_mm, level_deg = self.level_mm, self.level_deg
        if arm is not None and fused.rotation_deg is not None:
            if abs(fused.rotation_deg - level_deg) > HANGS_DEG or arm.height_mm < level_mm:
                level_mm, level_deg = arm.height_mm, fused.rotation_deg
            hangs = arm.height_mm - level_mm >= HANGS_MM
        else:
            hangs = False
        hangs = (self.hangs or aloft or hangs) and not putting_down
        return ArmContext(start_mm, moved_s, case, aloft, level_mm, level_deg, hangs)

    def leaves_table(self, case: ArmCase) -> bool:
        """Return whether the object leaves the table with this next case."""
        return case is ArmCase.MOVING and self.case is ArmCase.LIFT_OFF and not self.aloft


@dataclass(frozen=True, slots=True)
class SlipMemory:
    """All that is remembered between frames.

    Args:
        shift, sideways, shift_fingers: shift down and to the right, and the fingers that last knew it.
        switched_mm: by how much all changes of these fingers have moved the baselines of both: 2.5 mm at most.
        measured_s, captured_s: of the newest frame. followed_s: of the newest frame used for the resting angle.
        noise_deg2: variance of the rotation at rest.
        frames, counted_s: frames in a row that show slip, and the newest measurement of the last of them.
        far_frames: frames in a row beyond `rotation_max_deg`.
        rotations: episodes of rotational slip that were answered with force.
        had_rotation, had_slip: an episode of rotational slip, or of any slip, is over, answered or not.
    """

    baselines: Baselines = field(default_factory=Baselines)
    fingers: ReportingFingers = field(default_factory=ReportingFingers)
    shift: ShiftFilter = field(default_factory=ShiftFilter)
    sideways: ShiftFilter = field(default_factory=ShiftFilter)
    shift_fingers: tuple[str, ...] = ()
    switched_mm: tuple[float, float] = (0.0, 0.0)
    arm: ArmContext = field(default_factory=ArmContext)
    measured_s: float = -math.inf
    captured_s: float = -math.inf
    followed_s: float = -math.inf
    noise_deg2: float = NOISE_START_DEG**2
    frames: int = 0
    counted_s: float = -math.inf
    far_frames: int = 0
    rotations: int = 0
    had_rotation: bool = False
    had_slip: bool = False

    def baseline_changed(self, before: SlipMemory) -> bool:
        """Return whether rotations count from another angle than before, or come from other fingers."""
        if before.fingers.names and self.fingers.names != before.fingers.names:
            return True
        now_deg, before_deg = self.baselines.episode_deg, before.baselines.episode_deg
        if now_deg is None or before_deg is None:
            return now_deg is not before_deg
        return abs((now_deg - self.fingers.total_deg) - (before_deg - before.fingers.total_deg)) > SAME_DEG

    def after_episode(self, *, rotated: bool, raised: bool) -> SlipMemory:
        """Return the memory after an episode: only further motion counts. raised: it was answered with force."""
        baselines = replace(
            self.baselines,
            episode_deg=None,
            episode_mm=None,
            sideways_mm=None,
            resting_deg=None,
            before_motion_deg=None,
            unloaded_deg=None,
            unloaded_mm=None,
        )
        return replace(
            self,
            baselines=baselines,
            fingers=replace(self.fingers, switch=None),
            frames=0,
            rotations=self.rotations + (rotated and raised),
            had_rotation=self.had_rotation or rotated,
            had_slip=True,
        )

    def quick_threshold_deg(self, case: ArmCase, params: GuardParams) -> float:
        """Return the rotation that is slip where nothing else rotates the object: at rest, or in the first lift-off.

        It is the configured threshold, but at least NOISE_TIMES the noise learned at rest: 0.36 degrees at first.
        """
        given_deg = params.tuning.tighten_at_rest_deg
        if case is ArmCase.LIFT_OFF:
            given_deg = params.tuning.tighten_at_lift_off_deg
        return max(given_deg, NOISE_TIMES * min(math.sqrt(self.noise_deg2), NOISE_MAX_DEG))

    def switched(self, fused: FusedEstimate) -> SlipMemory:
        """Return the memory for the fingers that report now: all baselines move by the offset between fingers.

        The object's own motion in between, by its rates, is no part of the offset. A finger that comes and goes must
        not hide slip, so its offset is fixed when it first reports alone, and undone when it no longer does. One
        wrong frame must not stay in the offset: of two frames, and of the distance from the resting angle and from the
        last estimate, the smallest counts.
        """
        if fused.shift_fingers and fused.shift_fingers != self.shift_fingers:
            return self._shifts_switched(fused).switched(fused)
        fingers = self.fingers
        if fused.rotation_deg is None:
            return replace(self, fingers=replace(fingers, switch=None))
        if fused.fingers == fingers.names:
            return self._confirmed(fused)
        if not fingers.names:
            return replace(self, fingers=replace(fingers, names=fused.fingers, switch=None))
        known = {**dict(fingers.known), fingers.names: fingers.total_deg}
        switch = None
        if fused.fingers in known:
            by_deg = known[fused.fingers] - fingers.total_deg
        else:
            at_rest = self.arm.case is ArmCase.REST
            switch = FingerSwitch(fingers.last_deg, fingers.last_s, self.baselines.resting_deg if at_rest else None)
            by_deg = switch.offset_deg(fused, fingers.total_deg)
            switch = replace(switch, by_deg=by_deg, newest_at_s=fused.newest_at_s)
        fingers = ReportingFingers(
            fused.fingers,
            fingers.last_deg + by_deg,
            fingers.last_s,
            fingers.total_deg + by_deg,
            tuple(known.items()),
            switch,
        )
        return replace(self, fingers=fingers, baselines=self.baselines.moved(by_deg))

    def _shifts_switched(self, fused: FusedEstimate) -> SlipMemory:
        """Return the memory for the fingers that know the shift now: a finger that drops out is no slide."""
        if not self.shift_fingers:
            return replace(self, shift_fingers=fused.shift_fingers)
        total_mm, total_side_mm = self.switched_mm
        down_mm = within(total_mm + self.shift.jump_mm(fused.shift_mm), SWITCH_SHIFT_MM) - total_mm
        sideways_mm = within(total_side_mm + self.sideways.jump_mm(fused.sideways_mm), SWITCH_SHIFT_MM) - total_side_mm
        return replace(
            self,
            shift_fingers=fused.shift_fingers,
            switched_mm=(total_mm + down_mm, total_side_mm + sideways_mm),
            shift=self.shift.moved(down_mm),
            sideways=self.sideways.moved(sideways_mm),
            baselines=self.baselines.moved(0.0, down_mm, sideways_mm),
        )

    def _confirmed(self, fused: FusedEstimate) -> SlipMemory:
        """Return the memory after the second frame of a switch: the first one may have been wrong."""
        fingers = self.fingers
        switch = fingers.switch
        if switch is None or fused.measured_at_s <= switch.newest_at_s:
            return self
        if fused.captured_at_s - switch.newest_at_s > SECOND_FRAME_S:
            return replace(self, fingers=replace(fingers, switch=None))
        second_deg = switch.offset_deg(fused, fingers.total_deg - switch.by_deg)
        by_deg = min(switch.by_deg, second_deg, key=abs) - switch.by_deg
        fingers = replace(fingers, total_deg=fingers.total_deg + by_deg, switch=None)
        return replace(self, fingers=fingers, baselines=self.baselines.moved(by_deg))

    def followed(self, fused: FusedEstimate, case: ArmCase, *, new_rest: bool, params: GuardParams) -> SlipMemory:
        """Return the memory with the resting angle moved slowly towards the estimate, and the noise learned.

        case: what the arm does now. new_rest: its motion has just changed, so the present angle is the resting one.
        """
        baselines = self.baselines
        if fused.rotation_deg is None:
            return replace(self, baselines=replace(baselines, resting_deg=None))
        if baselines.resting_deg is None or new_rest:
            steady = case is not ArmCase.REST or abs(fused.rate_deg_s or 0.0) <= STEADY_DEG_S
            resting_deg = fused.rotation_deg if steady else None
            baselines = replace(baselines, resting_deg=resting_deg, previous_deg=None)
            return replace(self, baselines=baselines, followed_s=fused.measured_at_s)
        if case is not ArmCase.REST:
            return replace(self, followed_s=fused.measured_at_s)
        passed_s = fused.measured_at_s - self.followed_s
        if passed_s <= 0.0:
            return self
        away_deg = fused.rotation_deg - baselines.resting_deg
        if abs(away_deg) > self.quick_threshold_deg(case, params):
            return replace(self, baselines=replace(baselines, previous_deg=None), followed_s=fused.measured_at_s)
        noise_deg2 = self.noise_deg2
        if baselines.previous_deg is not None:  # from frame to frame, so that slow slip does not count as noise
            leap_deg2 = 0.5 * (fused.rotation_deg - baselines.previous_deg) ** 2
            noise_deg2 += (leap_deg2 - noise_deg2) / NOISE_FRAMES
        drift_deg = (1.0 - math.exp(-passed_s / FOLLOW_S)) * away_deg
        baselines = replace(
            baselines,
            resting_deg=baselines.resting_deg + drift_deg,
            previous_deg=fused.rotation_deg,
            before_motion_deg=plus(baselines.before_motion_deg, drift_deg),
        )
        return replace(self, baselines=baselines, noise_deg2=noise_deg2, followed_s=fused.measured_at_s)
