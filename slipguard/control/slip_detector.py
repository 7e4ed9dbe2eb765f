"""Distinguish slip from noise and from elastic torsion, estimate by estimate.

A gel under load twists and shifts elastically, too, but it comes to rest: rate and persistence distinguish slip from
it. How little counts as slip depends on the arm. An object at rest in the air rotates for one reason only, so a
fraction of a degree is enough. While the arm moves, the gel twists with the load: by as much as it is twisted already,
times the change of the load. While an object leaves the table, the gel is loaded for the first time, and no image
distinguishes that from slip, for the far end still rests on the table. So the grip is raised at each further degree.
What the gel is known to move without slip (needed_force.py) is never slip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control.elastic_share import NO_SHARE, ElasticShare, elastic_share
from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.needed_force import ElasticMotion
from slipguard.control.params import GuardParams
from slipguard.control.slide_direction import slide_direction
from slipguard.control.slip_baselines import SETTLED_SHIFT_MM
from slipguard.control.slip_memory import ArmCase, SlipMemory
from slipguard.devices import ArmState

TORSION_ON_TABLE_DEG = 6.0
"""While the load still arrives, an object may come to rest this much further out without slip."""
GROWTH_MAX = 4.0
"""However often the grip was tightened, no threshold grows beyond this multiple."""
SWING_SHARE = 0.5
"""Arms stop with 2.5 m/s2, a quarter of gravity, and a gel without much damping responds with twice that."""
PLAIN_TIMES = 1.5
"""In a lift-off, a rotation estimated by both fingers counts as two frames if it exceeds this multiple of its threshold
and the previous frame already showed BEGUN_SHARE of the threshold. A leap in one frame is a flash of light or a knock.
"""
PLAIN_SLIDE_TIMES = 2.0
"""A fast slide that both fingers see beyond this multiple of its threshold needs no second frame: an object in free
fall is lost after 50 ms. It does not matter how often the grip was tightened before."""
STIFF_SHARE = 0.5
"""A slide counts from this share of `slip_mm` on where the gel slips earlier than that: a stiff one does not swing."""
BEGUN_SHARE = 0.25
APART_S = 0.02
"""At rest there is time to confirm: both fingers' frames are this much later than the first one's, or one flash of
light that falls on a frame of each counts twice."""
AGAIN_SHARE = 0.35
"""After a slip the gel is at its elastic limit, and a step raises that by this share: 1 - 1 / `search` in needed_force.
Once the object hangs, the load has arrived, and what still moves it is mostly the arm: then all counts again."""
AHEAD_S = 0.1
"""While an object leaves the table, what a rate above `slip_rate_deg_s` adds in this time counts, too: a short lever
rotates at 40 degrees/s."""
CHANGE_SHARE = 0.5
"""In a lift-off only this share of sigma counts towards the threshold: the rest is the same from frame to frame and
cancels in a change. At rest there is time to be sure, and the whole sigma counts."""

NO_MOTION = ElasticMotion()


@dataclass(frozen=True, slots=True)
class SlipAssessment:
    """What one estimate shows.

    Args:
        memory: the memory after it.
        rotation_deg: away from the episode's baseline, without sign; rate_deg_s: positive while that grows.
        slip_mm, slip_rate_mm_s: distance from that baseline, in any direction, and the rate away from it. direction: in
            words, empty if unknown. slides: by an unknown distance.
        moving: one of the rates is that of slip.
        share: of the elastic limit. elastic: all of the motion is within that limit.
        rotates, translates: this frame shows rotational or translational slip.
        slipping: slip is confirmed by enough frames.
        settled_s: the object has been at rest for this time.
    """

    memory: SlipMemory
    rotation_deg: float = 0.0
    rate_deg_s: float = 0.0
    slip_mm: float = 0.0
    slip_rate_mm_s: float = 0.0
    direction: str = ""
    slides: bool = False
    moving: bool = False
    share: ElasticShare = NO_SHARE
    elastic: bool = False
    rotates: bool = False
    translates: bool = False
    slipping: bool = False
    settled_s: float = 0.0

    @property
    def what(self) -> str:
        """The motion in words, with values."""
        rotation = f"rotated {self.rotation_deg:.1f}° at {self.rate_deg_s:.0f}°/s"
        if self.slides:
            return f"{rotation}, slides by an unknown distance"
        if self.slip_mm <= SETTLED_SHIFT_MM:
            return rotation
        return f"{rotation}, moved {self.slip_mm:.1f} mm {self.direction}".rstrip()


def assess_slip(
    memory: SlipMemory,
    fused: FusedEstimate,
    params: GuardParams,
    *,
    arm: ArmState | None = None,
    elastic_limit: ElasticMotion = NO_MOTION,
    again_deg: float = TORSION_ON_TABLE_DEG,
    only_outward: bool = False,
) -> SlipAssessment:
    """Return what the newest estimate shows, compared with the baselines.

    Args:
        memory: from the step before.
        fused: the newest estimate; the same one may come several times.
        params: thresholds.
        arm: its newest state; without it every rotation is judged as in motion.
        elastic_limit: motion that the grip takes up elastically, without slip.
        again_deg: further rotation that is slip in a lift-off that has seen slip already.
        only_outward: a rotation back towards the reference is no slip, as when an object is put down.
    """
    is_new = fused.measured_at_s > memory.measured_s  # of both fingers: what one frame shows counts once
    memory = memory.switched(fused)
    rested_deg = memory.baselines.resting_deg  # before this frame
    memory, new_rest = _update_memory(memory, fused, arm, params, putting_down=only_outward)
    memory, rests_further_out = _update_baselines(
        memory, fused, params, is_new=is_new, new_rest=new_rest, rested=rested_deg
    )
    rotation_deg, rate_deg_s, rotates = _rotation(memory, fused, params, again_deg, only_outward)
    quick_frames = 0 if new_rest else _quick_frames(memory, fused, params, rested_deg, only_outward)
    share = elastic_share(memory, fused, elastic_limit)
    arrives = memory.had_slip and memory.arm.case is ArmCase.LIFT_OFF and not memory.arm.hangs
    elastic = elastic_limit.deg > 0.0 and share.used <= (AGAIN_SHARE if arrives else 1.0)
    if elastic:
        rotates, rests_further_out, quick_frames = False, False, 0
    quick_rotation = quick_frames > 0
    slip_mm, rate_mm_s, direction = _slide(memory, fused, arm, only_outward)
    tuning = params.tuning
    fast = rate_mm_s >= tuning.slip_rate_mm_s
    least_mm = min(max(STIFF_SHARE * tuning.slip_mm, elastic_limit.mm), tuning.slip_mm)
    translates = slip_mm > least_mm and (fast or slip_mm > tuning.creep_mm)
    translates = translates and not elastic
    both = len(fused.shift_fingers) == 2 and fused.shift_conflict is None
    if translates and fast and slip_mm > PLAIN_SLIDE_TIMES * least_mm and both:
        quick_frames = max(quick_frames, tuning.confirm_frames)
    slides = fused.slides and not only_outward
    translates = translates or slides
    if is_new:
        memory = _count(memory, fused, rotates or rests_further_out or translates, quick_frames, params)
    settled_since_s = memory.baselines.settled_since_s
    return SlipAssessment(
        memory=memory,
        rotation_deg=rotation_deg,
        rate_deg_s=rate_deg_s,
        slip_mm=slip_mm,
        slip_rate_mm_s=rate_mm_s,
        direction=direction,
        slides=slides,
        moving=rate_deg_s >= tuning.slip_rate_deg_s or fast or slides,
        share=share,
        elastic=elastic,
        rotates=rotates or rests_further_out or quick_rotation,
        translates=translates,
        slipping=memory.frames >= tuning.confirm_frames,
        settled_s=memory.captured_s - settled_since_s if settled_since_s is not None else 0.0,
    )


def growth(episodes: int, params: GuardParams) -> float:
    """Return the multiple of the thresholds after this many episodes that were answered with force."""
    return min(params.tuning.threshold_growth**episodes, GROWTH_MAX)


def uncertainty_deg(sigma_deg: float, params: GuardParams) -> float:
    """Return the rotation that may be no more than the estimate's error."""
    return min(params.tuning.threshold_sigmas * sigma_deg, params.tuning.sigma_threshold_max_deg)


def threshold_deg(sigma_deg: float, episodes: int, params: GuardParams) -> float:
    """Return the rotation below which nothing is slip after this many episodes of it, however the arm moves."""
    return max(params.tuning.tighten_in_motion_deg, uncertainty_deg(sigma_deg, params)) * growth(episodes, params)


def _update_memory(
    memory: SlipMemory, fused: FusedEstimate, arm: ArmState | None, params: GuardParams, *, putting_down: bool
) -> tuple[SlipMemory, bool]:
    """Return the memory with arm, resting angle and shift followed, and whether the arm's motion has just changed.

    At such a change, the elastic torsion up to now is the new baseline.
    """
    before = memory.arm
    context = before.next(fused, arm, putting_down=putting_down)
    new_rest = context.case is not before.case and (context.case is ArmCase.REST or before.case is ArmCase.LIFT_OFF)
    baselines = memory.baselines
    if before.leaves_table(context.case) or putting_down:
        baselines = replace(baselines, before_motion_deg=None)
    elif context.case is ArmCase.REST and baselines.before_motion_deg is None:
        baselines = replace(baselines, before_motion_deg=fused.rotation_deg)
    passed_s = fused.captured_at_s - memory.captured_s
    shift, sideways = memory.shift.next(fused.shift_mm, passed_s), memory.sideways.next(fused.sideways_mm, passed_s)
    memory = replace(memory, arm=context, baselines=baselines, shift=shift, sideways=sideways)
    return memory.followed(fused, context.case, new_rest=new_rest, params=params), new_rest


def _update_baselines(
    memory: SlipMemory, fused: FusedEstimate, params: GuardParams, *, is_new: bool, new_rest: bool, rested: float | None
) -> tuple[SlipMemory, bool]:
    """Return the memory with the baselines of this frame, and whether the object rests further out than before.

    rested: the resting angle before this frame.
    """
    baselines = memory.baselines
    rebased = new_rest or baselines.episode_deg is None
    unloaded_mm = baselines.unloaded_mm
    if unloaded_mm is None and fused.shift_mm is not None:
        unloaded_mm = (fused.shift_mm, fused.sideways_mm or 0.0)
    baselines = replace(
        baselines,
        unloaded_deg=fused.rotation_deg if baselines.unloaded_deg is None else baselines.unloaded_deg,
        unloaded_mm=unloaded_mm,
        episode_deg=fused.rotation_deg if rebased else baselines.episode_deg,
        episode_mm=fused.shift_mm if new_rest or baselines.episode_mm is None else baselines.episode_mm,
        sideways_mm=fused.sideways_mm if new_rest or baselines.sideways_mm is None else baselines.sideways_mm,
    )
    further_out_from = _further_out_from(replace(memory, baselines=baselines), fused, params)
    if further_out_from is not None:
        baselines = replace(baselines, episode_deg=further_out_from)
    fingers = memory.fingers
    if further_out_from is not None or rebased or rested is None:  # these fingers' own baselines: nothing to confirm
        fingers = replace(fingers, switch=None)
    memory = replace(
        memory,
        baselines=baselines.with_settled(fused, params),
        fingers=fingers,
        measured_s=max(fused.measured_at_s, fused.newest_at_s) if is_new else memory.measured_s,
        captured_s=max(fused.captured_at_s, memory.captured_s),
    )
    return memory, further_out_from is not None


def _count(memory: SlipMemory, fused: FusedEstimate, plain: bool, quick_frames: int, params: GuardParams) -> SlipMemory:
    """Return the memory with a new estimate counted: more frames in a row that show slip, or none.

    plain: it shows slip for any motion of the arm. quick_frames: how many frames it counts for where nothing should
    move.
    """
    counts = max(int(plain), quick_frames)
    again_at_rest = memory.arm.case is ArmCase.REST and memory.frames > 0 and not plain
    waits = counts > 0 and again_at_rest and fused.measured_at_s < memory.counted_s + APART_S
    far = abs(fused.rotation_deg or 0.0) > params.tuning.rotation_max_deg and fused.conflict is None
    fingers = memory.fingers
    if fused.rotation_deg is not None:
        fingers = replace(fingers, last_deg=fused.rotation_deg, last_s=fused.captured_at_s)
    return replace(
        memory,
        fingers=fingers,
        frames=memory.frames if waits else memory.frames + counts if counts else 0,
        counted_s=fused.newest_at_s if counts and not waits else memory.counted_s,
        far_frames=memory.far_frames + 1 if far else 0,
    )


def _further_out_from(memory: SlipMemory, fused: FusedEstimate, params: GuardParams) -> float | None:
    """Return where an object was that now rests further out than at its last rest; None if it does not.

    At rest the same load twists the gel by the same angle, except after the first lift.
    """
    rested_deg, episode_deg = memory.baselines.before_motion_deg, memory.baselines.episode_deg
    if fused.rotation_deg is None or fused.sigma_deg is None or episode_deg is None:
        return None
    if rested_deg is None or memory.arm.case is not ArmCase.REST:
        return None
    rotation_deg = fused.rotation_deg
    least_deg = threshold_deg(fused.sigma_deg, memory.rotations, params)
    least_deg = least_deg if memory.arm.aloft else max(least_deg, TORSION_ON_TABLE_DEG)
    if abs(rotation_deg - rested_deg) <= least_deg or abs(rotation_deg) <= abs(rested_deg):
        return None
    return max(rested_deg, episode_deg, key=lambda baseline_deg: abs(rotation_deg - baseline_deg))


def _rotation(
    memory: SlipMemory, fused: FusedEstimate, params: GuardParams, again_deg: float, only_outward: bool
) -> tuple[float, float, bool]:
    """Return rotation from the episode baseline, rate away from it, and whether that is slip however the arm moves."""
    episode_deg, tuning = memory.baselines.episode_deg, params.tuning
    if fused.rotation_deg is None or fused.sigma_deg is None or episode_deg is None:
        return 0.0, 0.0, False
    away_deg = fused.rotation_deg - episode_deg
    rotation_deg = abs(away_deg)
    rate_deg_s = math.copysign(1.0, away_deg) * (fused.rate_deg_s or 0.0)
    if only_outward and abs(fused.rotation_deg) <= abs(episode_deg):
        return 0.0, 0.0, False
    least_deg = threshold_deg(fused.sigma_deg, memory.rotations, params)
    creep_deg = tuning.creep_deg * growth(memory.rotations, params)
    if memory.arm.case is ArmCase.MOVING:
        least_deg = max(least_deg, SWING_SHARE * abs(episode_deg))
    if memory.arm.case is ArmCase.LIFT_OFF and memory.had_rotation:
        # The far end on the table leads the rotation: its rate is the arm's.
        soon_deg = rotation_deg + AHEAD_S * max(rate_deg_s - tuning.slip_rate_deg_s, 0.0)
        begun = rotation_deg > memory.quick_threshold_deg(ArmCase.LIFT_OFF, params)
        return rotation_deg, rate_deg_s, begun and soon_deg > again_deg
    fast = rate_deg_s >= tuning.slip_rate_deg_s
    return rotation_deg, rate_deg_s, rotation_deg > least_deg and (fast or rotation_deg > max(creep_deg, least_deg))


def _slide(
    memory: SlipMemory, fused: FusedEstimate, arm: ArmState | None, only_outward: bool
) -> tuple[float, float, str]:
    """Return how far the contact has moved from the episode's baseline, its rate away from there, and the direction."""
    baselines = memory.baselines
    down_mm = (fused.shift_mm or 0.0) - (baselines.episode_mm or 0.0) if fused.shift_mm is not None else 0.0
    side_mm = (fused.sideways_mm or 0.0) - (baselines.sideways_mm or 0.0) if fused.sideways_mm is not None else 0.0
    slip_mm = math.hypot(down_mm, side_mm)
    from_start_mm = math.hypot(fused.shift_mm or 0.0, fused.sideways_mm or 0.0)
    back = from_start_mm <= math.hypot(baselines.episode_mm or 0.0, baselines.sideways_mm or 0.0)
    if slip_mm == 0.0 or (only_outward and back):
        return 0.0, 0.0, ""
    direction = slide_direction(down_mm, side_mm, arm.orientation_rad if arm is not None else None)
    return slip_mm, (down_mm * memory.shift.rate_mm_s + side_mm * memory.sideways.rate_mm_s) / slip_mm, direction


def _quick_frames(
    memory: SlipMemory,
    fused: FusedEstimate,
    params: GuardParams,
    rested_deg: float | None,
    only_outward: bool,
) -> int:
    """Return for how many frames a rotation from the resting angle counts, where nothing but slip should rotate it.

    rested_deg: the resting angle before this frame.
    """
    case = memory.arm.case
    if fused.rotation_deg is None or fused.sigma_deg is None or rested_deg is None or only_outward:
        return 0
    if case is ArmCase.MOVING or (case is ArmCase.LIFT_OFF and memory.had_rotation):
        return 0
    if fused.conflict is not None:  # the larger of two rotations is used then, a leap in itself
        return 0
    away_deg = fused.rotation_deg - rested_deg
    error_share = CHANGE_SHARE if case is ArmCase.LIFT_OFF else 1.0
    least_deg = memory.quick_threshold_deg(case, params)
    least_deg = max(least_deg, error_share * uncertainty_deg(fused.sigma_deg, params))
    least_deg *= growth(memory.rotations, params)
    if abs(away_deg) <= least_deg:
        return 0
    if case is ArmCase.REST:
        return 1
    begun = math.copysign(1.0, away_deg) * (memory.fingers.last_deg - rested_deg) > BEGUN_SHARE * least_deg
    return 2 if abs(away_deg) > PLAIN_TIMES * least_deg and begun and len(fused.fingers) == 2 else 1
