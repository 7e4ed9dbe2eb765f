"""Tells slip from noise: a turn or a slide beyond its level, at a rate, in several measured frames.

A gel that winds up under load turns and slides too, but it comes to rest; rate and persistence tell the two apart, and
what the arm does says how much of it is to be expected (`alert`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.params import GuardParams
from slipguard.control.slip_baselines import CALM_SHIFT_MM, SlipMemory, follow_rest, follow_shift, handed_over
from slipguard.control.slip_thresholds import (
    SWING_SHARE,
    MotionCase,
    attend,
    growth,
    level_deg,
    quick_level_deg,
    unsure_deg,
)
from slipguard.devices import ArmState

PLAIN_TIMES = 1.5
"""In a lift-off a turn beyond so many times its level, told by both fingers, counts as two frames,"""
BEGUN_SHARE = 0.25
"""if the frame before had begun it by this share of the level: one that leaps alone is a flash of light or a knock."""
APART_S = 0.02
"""At rest there is time for a second look: both fingers' frames so much later than the first one's, or one flash of
light that falls on a frame of each counts twice."""
CHANGE_SHARE = 0.5
"""Half of a turn's sigma is alike from frame to frame and falls out of a change; the rest was learnt at rest, before
the lift. At rest itself there is time to be sure."""


@dataclass(frozen=True, slots=True)
class SlipAssessment:
    """What one look saw.

    rotation_deg: away from the base, without sign. rate_deg_s: positive while that grows. slip_mm, slip_rate_mm_s:
    downwards. moving: one of the rates is that of slip. turns, slides: this frame shows slip of that kind.
    slipping: slip, in enough frames. still_s: at rest for so long.
    """

    detector: SlipMemory
    rotation_deg: float = 0.0
    rate_deg_s: float = 0.0
    slip_mm: float = 0.0
    slip_rate_mm_s: float = 0.0
    moving: bool = False
    rotations: bool = False
    slides: bool = False
    slipping: bool = False
    still_s: float = 0.0

    @property
    def what(self) -> str:
        """In words, with figures."""
        rotation = f"turned {self.rotation_deg:.1f}° at {self.rate_deg_s:.0f}°/s"
        return f"{rotation}, slid {self.slip_mm:.1f} mm" if self.slip_mm > CALM_SHIFT_MM else rotation


def look(
    detector: SlipMemory,
    fused: FusedEstimate,
    params: GuardParams,
    *,
    arm: ArmState | None = None,
    firm: bool = False,
    only_outward: bool = False,
) -> SlipAssessment:
    """Compare the newest answer with the base.

    arm: its newest state; without it no turn is as suspicious as it is at rest. firm: the grip uses most of the budget.
    only_outward: a turn back towards the reference is no slip, as when an object is put down.
    """
    new = fused.measured_at_s > detector.measured_s  # both fingers: what one frame shows counts once
    detector = handed_over(detector, fused)
    near_deg = detector.alert.near_deg
    alert = attend(detector.alert, fused, arm, params, putting_down=only_outward)
    detector = replace(follow_shift(detector, fused), alert=alert)
    anew = alert.anew  # what the arm's motion has wound up stays
    rebased = anew or detector.base_rotation_deg is None
    detector = replace(
        detector,
        base_rotation_deg=fused.rotation_deg if rebased else detector.base_rotation_deg,
        base_shift_mm=fused.shift_mm if anew or detector.base_shift_mm is None else detector.base_shift_mm,
        measured_s=max(fused.measured_at_s, fused.newest_at_s) if new else detector.measured_s,
        captured_s=max(fused.captured_at_s, detector.captured_s),
    )
    strayed_from_deg = _strayed_from(detector, fused, params)
    if strayed := strayed_from_deg is not None:
        detector = replace(detector, base_rotation_deg=strayed_from_deg)
    if strayed or rebased or near_deg is None:  # these fingers' own places move by no second look
        detector = replace(detector, handover=None)
    detector = follow_rest(detector, fused, params)
    rotation, rate, rotating = _rotating(detector, fused, params, only_outward)
    suddenly = 0 if anew else _suddenly(detector, fused, params, near_deg, firm, only_outward)
    slide = (fused.shift_mm or 0.0) - (detector.base_shift_mm or 0.0) if fused.shift_mm is not None else 0.0
    slides_fast = detector.slip_rate_mm_s >= params.tuning.slip_rate_mm_s
    times = growth(detector.slides, params)
    sliding = slide > params.tuning.slip_mm * times and (slides_fast or slide > params.tuning.creep_mm * times)
    if new:
        detector = _counted(detector, fused, rotating or strayed or sliding, suddenly, params)
    return SlipAssessment(
        detector=detector,
        rotation_deg=rotation,
        rate_deg_s=rate,
        slip_mm=slide,
        slip_rate_mm_s=detector.slip_rate_mm_s,
        moving=rate >= params.tuning.slip_rate_deg_s or slides_fast,
        rotations=rotating or strayed or suddenly > 0,
        slides=sliding,
        slipping=detector.frames >= params.tuning.confirm_frames,
        still_s=detector.captured_s - detector.rest_since_s if detector.rest_since_s is not None else 0.0,
    )


def _counted(
    detector: SlipMemory, fused: FusedEstimate, plainly: bool, suddenly: int, params: GuardParams
) -> SlipMemory:
    """What a new answer adds to the frames that show slip, or that none is left of them.

    plainly: it shows slip whatever the arm does. suddenly: for how many frames it counts where nothing should move.
    """
    counts = max(int(plainly), suddenly)
    at_rest_again = detector.alert.case is MotionCase.REST and detector.frames > 0 and not plainly
    waits = counts > 0 and at_rest_again and fused.measured_at_s < detector.counted_s + APART_S
    far = abs(fused.rotation_deg or 0.0) > params.tuning.rotation_max_deg and fused.conflict is None
    return replace(
        detector,
        frames=detector.frames if waits else detector.frames + counts if counts else 0,
        counted_s=fused.newest_at_s if counts and not waits else detector.counted_s,
        far_frames=detector.far_frames + 1 if far else 0,
        told_deg=detector.told_deg if fused.rotation_deg is None else fused.rotation_deg,
        told_s=detector.told_s if fused.rotation_deg is None else fused.captured_at_s,
    )


def _strayed_from(detector: SlipMemory, fused: FusedEstimate, params: GuardParams) -> float | None:
    """Where an object was that rests further out than at its last rest: what turned it in between has come to stay.

    None if it does not. At rest the same load winds the gel up by the same angle, but for the first time the arm has
    lifted it.
    """
    alert, base_deg = detector.alert, detector.base_rotation_deg
    if fused.rotation_deg is None or fused.sigma_deg is None or base_deg is None:
        return None
    if alert.rested_deg is None or alert.case is not MotionCase.REST:
        return None
    rotation_deg = fused.rotation_deg
    level = level_deg(fused.sigma_deg, detector.rotations, params)
    level = level if alert.aloft else max(level, params.tuning.torsion_after_tightening_deg)
    if abs(rotation_deg - alert.rested_deg) <= level or abs(rotation_deg) <= abs(alert.rested_deg):
        return None
    return max(alert.rested_deg, base_deg, key=lambda place_deg: abs(rotation_deg - place_deg))


def _rotating(
    detector: SlipMemory, fused: FusedEstimate, params: GuardParams, only_outward: bool
) -> tuple[float, float, bool]:
    """Turn from the base, rate away from it, and whether that is slip whatever the arm does."""
    if fused.rotation_deg is None or fused.sigma_deg is None or detector.base_rotation_deg is None:
        return 0.0, 0.0, False
    away_deg = fused.rotation_deg - detector.base_rotation_deg
    rotation_deg = abs(away_deg)
    rate_deg_s = math.copysign(1.0, away_deg) * (fused.rate_deg_s or 0.0)
    if only_outward and abs(fused.rotation_deg) <= abs(detector.base_rotation_deg):
        return rotation_deg, 0.0, False
    level = level_deg(fused.sigma_deg, detector.rotations, params)
    creep_deg = params.tuning.creep_deg * growth(detector.rotations, params)
    if detector.alert.case is MotionCase.MOVING:
        level = max(level, SWING_SHARE * abs(detector.base_rotation_deg))
    if detector.alert.case is MotionCase.LIFT_OFF and detector.patient:
        # The far end still on its table leads the turn: its rate is the arm's.
        return rotation_deg, rate_deg_s, rotation_deg > params.tuning.torsion_after_tightening_deg
    fast = rate_deg_s >= params.tuning.slip_rate_deg_s
    return rotation_deg, rate_deg_s, rotation_deg > level and (fast or rotation_deg > max(creep_deg, level))


def _suddenly(
    detector: SlipMemory,
    fused: FusedEstimate,
    params: GuardParams,
    near_deg: float | None,
    firm: bool,
    only_outward: bool,
) -> int:
    """For how many frames a turn from where the object rested counts, where nothing but slip should turn it.

    near_deg: where it rested before this look.
    """
    alert = detector.alert
    if fused.rotation_deg is None or fused.sigma_deg is None or near_deg is None or only_outward:
        return 0
    if alert.case is MotionCase.MOVING or (alert.case is MotionCase.LIFT_OFF and detector.patient):
        return 0
    if fused.conflict is not None:  # it is the larger of two turns then, a leap in itself
        return 0
    away_deg = fused.rotation_deg - near_deg
    may_change = CHANGE_SHARE if alert.case is MotionCase.LIFT_OFF else 1.0
    quick_deg = quick_level_deg(alert, params, firm=firm)
    level = max(quick_deg, may_change * unsure_deg(fused.sigma_deg, params)) * growth(detector.rotations, params)
    if abs(away_deg) <= level:
        return 0
    if alert.case is MotionCase.REST:
        return 1
    begun = math.copysign(1.0, away_deg) * (detector.told_deg - near_deg) > BEGUN_SHARE * level
    return 2 if abs(away_deg) > PLAIN_TIMES * level and begun and len(fused.fingers) == 2 else 1
