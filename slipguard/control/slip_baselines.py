"""What is remembered of a held object from frame to frame: where it was, where it rests, and who told it."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.params import GuardParams
from slipguard.control.slip_thresholds import MotionCase, RestingPlace, moved

SHIFT_TAU_S = 0.05
"""Time constant of the filtered derivative of the shift: three frames at 60 fps."""
CALM_SHIFT_MM = 0.3
"""A patch centre that wanders less than this is at rest; its noise is about 0.05 mm."""
HANDOVER_DEG, HANDOVER_MM = 2.0, 0.5
"""Two fingers tell the same turn and the same slide no further apart than this, all in all; more is motion."""
SAME_DEG = 1e-6
"""Places no further apart are one, but for rounding."""
SECOND_LOOK_S = 0.1
"""A later frame is no second look at a change of finger: the object may have turned."""


@dataclass(frozen=True, slots=True)
class Handover:
    """Others, of whom nothing is known yet, tell the turn since a moment ago.

    told: what was told before, and when. near: where the turn was on average while the arm stood, None while it moved.
    by: what it moved. newest_at_s: of the measurements that moved it.
    """

    told_deg: float
    told_s: float
    near_deg: float | None
    by_deg: float = 0.0
    newest_at_s: float = -math.inf


@dataclass(frozen=True, slots=True)
class SlipMemory:
    """What is remembered between frames.

    base: where the object was when it was last calm. turns, slides: episodes of either that were answered with force.
    patient: one of turning is over, answered or not. told: who told the turn last, what and when.
    handed: by how much all changes of finger have moved it. known: how much that is with which fingers, of those who
    have told. handover: the last change, until it has been looked at twice. frames, counted_s: how many in a row showed
    slip, and the newest measurement of the last of them. far_frames: measured frames in a row beyond the turn at which
    it is given up.
    """

    base_rotation_deg: float | None = None
    base_shift_mm: float | None = None
    measured_s: float = -math.inf
    captured_s: float = -math.inf
    frames: int = 0
    counted_s: float = -math.inf
    far_frames: int = 0
    rotations: int = 0
    slides: int = 0
    patient: bool = False
    told_by: tuple[str, ...] = ()
    told_deg: float = 0.0
    told_s: float = 0.0
    handed_deg: float = 0.0
    handed_mm: float = 0.0
    known: tuple[tuple[tuple[str, ...], float], ...] = ()
    handover: Handover | None = None
    smooth_shift_mm: float | None = None
    slip_rate_mm_s: float = 0.0
    rest_rotation_deg: float | None = None
    rest_shift_mm: float | None = None
    rest_since_s: float | None = None
    alert: RestingPlace = field(default_factory=RestingPlace)

    def elsewhere(self, before: SlipMemory) -> bool:
        """Whether turns count from another place than before, or are told by others, who may contradict them."""
        if before.told_by and self.told_by != before.told_by:
            return True
        if self.base_rotation_deg is None or before.base_rotation_deg is None:
            return self.base_rotation_deg is not before.base_rotation_deg
        moved_deg = (self.base_rotation_deg - self.handed_deg) - (before.base_rotation_deg - before.handed_deg)
        return abs(moved_deg) > SAME_DEG

    def rebased(self, *, rotated: bool, slid: bool, raised: bool) -> SlipMemory:
        """An episode is over: from here on only what moves further counts. raised: it was answered with force."""
        return replace(
            self,
            base_rotation_deg=None,
            base_shift_mm=None,
            frames=0,
            handover=None,
            rotations=self.rotations + (rotated and raised),
            slides=self.slides + (slid and raised),
            patient=self.patient or rotated,
            alert=replace(self.alert, near_deg=None, rested_deg=None),
        )


def handed_over(detector: SlipMemory, fused: FusedEstimate) -> SlipMemory:
    """Other fingers than before tell the turn: what is remembered moves by the difference between them.

    What the object has turned and slid in between, by its rates, is no part of that, nor what is beyond all difference.
    A finger that comes and goes hides no slip: by what it differs is settled when it first tells alone, and undone when
    it does no longer. What a single frame is off by would stay for good: the smallest difference counts, of two
    frames, and from where the turn was on average as from where it was told last.
    """
    if fused.rotation_deg is None:
        return replace(detector, handover=None)
    if fused.fingers == detector.told_by:
        return _seen_twice(detector, fused)
    now = replace(detector, told_by=fused.fingers, handover=None)
    if not detector.told_by:
        return now
    known = {**dict(now.known), detector.told_by: now.handed_deg}
    now = replace(now, known=tuple(known.items()))
    if fused.fingers in known:
        by_deg = known[fused.fingers] - now.handed_deg
    else:
        first = Handover(now.told_deg, now.told_s, now.alert.near_deg if now.alert.case is MotionCase.REST else None)
        by_deg = _differ_by(first, fused, now.handed_deg)
        now = replace(now, handover=replace(first, by_deg=by_deg, newest_at_s=fused.newest_at_s))
    now = replace(_moved_by(now, by_deg), told_deg=now.told_deg + by_deg)
    if fused.shift_mm is None or now.smooth_shift_mm is None:
        return now
    slid_mm = now.slip_rate_mm_s * SHIFT_TAU_S
    handed_mm = _within(now.handed_mm + fused.shift_mm - now.smooth_shift_mm - slid_mm, HANDOVER_MM)
    by_mm = handed_mm - now.handed_mm
    return replace(
        now,
        handed_mm=handed_mm,
        base_shift_mm=moved(now.base_shift_mm, by_mm),
        rest_shift_mm=moved(now.rest_shift_mm, by_mm),
        smooth_shift_mm=now.smooth_shift_mm + by_mm,
    )


def _seen_twice(detector: SlipMemory, fused: FusedEstimate) -> SlipMemory:
    """The first frame after a change of fingers may have been off by itself."""
    first = detector.handover
    if first is None or fused.measured_at_s <= first.newest_at_s:
        return detector
    if fused.captured_at_s - first.newest_at_s > SECOND_LOOK_S:
        return replace(detector, handover=None)
    second_deg = _differ_by(first, fused, detector.handed_deg - first.by_deg)
    by_deg = min(first.by_deg, second_deg, key=abs)
    return replace(_moved_by(detector, by_deg - first.by_deg), handover=None)


def _differ_by(before: Handover, fused: FusedEstimate, handed_deg: float) -> float:
    """How far these fingers are from what the others told, but for what the object has turned since."""
    rotation_deg = fused.rotation_deg or 0.0
    rotated_deg = (fused.rate_deg_s or 0.0) * (fused.captured_at_s - before.told_s)
    by_deg = rotation_deg - before.told_deg - rotated_deg
    if before.near_deg is not None:
        by_deg = min(by_deg, rotation_deg - before.near_deg, key=abs)
    return _within(handed_deg + by_deg, HANDOVER_DEG) - handed_deg


def _moved_by(detector: SlipMemory, by_deg: float) -> SlipMemory:
    """The places that are remembered, moved to where these fingers would have seen them."""
    return replace(
        detector,
        handed_deg=detector.handed_deg + by_deg,
        base_rotation_deg=moved(detector.base_rotation_deg, by_deg),
        rest_rotation_deg=moved(detector.rest_rotation_deg, by_deg),
        alert=detector.alert.handed_over(by_deg),
    )


def follow_shift(detector: SlipMemory, fused: FusedEstimate) -> SlipMemory:
    """Filtered derivative of the shift; the first shift after none starts it anew."""
    if fused.shift_mm is None:
        return replace(detector, smooth_shift_mm=None, slip_rate_mm_s=0.0)
    if detector.smooth_shift_mm is None:
        return replace(detector, smooth_shift_mm=fused.shift_mm)
    passed_s = fused.captured_at_s - detector.captured_s
    if passed_s <= 0.0:
        return detector
    share = 1.0 - math.exp(-passed_s / SHIFT_TAU_S)
    smooth_mm = detector.smooth_shift_mm + share * (fused.shift_mm - detector.smooth_shift_mm)
    return replace(detector, smooth_shift_mm=smooth_mm, slip_rate_mm_s=(fused.shift_mm - smooth_mm) / SHIFT_TAU_S)


def follow_rest(detector: SlipMemory, fused: FusedEstimate, params: GuardParams) -> SlipMemory:
    """Where the object rests and since when: within `calm_deg` (or two sigma) and 0.3 mm of one place."""
    calm_deg = max(params.tuning.settle_deg, min(2.0 * (fused.sigma_deg or 0.0), params.tuning.sigma_threshold_max_deg))
    rests = _near(fused.rotation_deg, detector.rest_rotation_deg, calm_deg) and _near(
        fused.shift_mm, detector.rest_shift_mm, CALM_SHIFT_MM
    )
    if rests and detector.rest_since_s is not None:
        return replace(
            detector,
            rest_rotation_deg=fused.rotation_deg if detector.rest_rotation_deg is None else detector.rest_rotation_deg,
            rest_shift_mm=fused.shift_mm if detector.rest_shift_mm is None else detector.rest_shift_mm,
        )
    return replace(
        detector, rest_rotation_deg=fused.rotation_deg, rest_shift_mm=fused.shift_mm, rest_since_s=fused.captured_at_s
    )


def _near(value: float | None, place: float | None, within: float) -> bool:
    return value is None or place is None or abs(value - place) <= within


def _within(value: float, most: float) -> float:
    return min(max(value, -most), most)
