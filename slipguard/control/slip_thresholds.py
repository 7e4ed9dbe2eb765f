"""How little may count as slip now: the sensor's own noise, what the arm does, and where the object rested before.

An object at rest in the air turns for one reason only, so a fraction of a degree is enough there. While the arm moves,
the gel winds up and down with the load: by as much as it is wound up already, times the load's change. And while an
object leaves the table, the gel winds up for the first time: nothing in the picture tells that from slip, for the far
end still rests on the table and leads the turn. So the grip is raised at once then, once, for that costs little; after
that it is believed to hold for some degrees more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import Enum

from slipguard.control.finger_fusion import FusedEstimate
from slipguard.control.params import GuardParams
from slipguard.devices import ArmState

SETTLE_S = 0.4
"""After the arm has come to rest the gel still swings for so long."""
LIFT_OFF_MM = 80.0
"""An arm that has risen by less since the grip may still be taking the object off its table: the far end of something
held 200 mm from it stays down up to 70 mm on a gel that winds up by 20 degrees."""
FOLLOW_S = 3.0
"""At rest the place from which a turn counts follows slowly: light drifts, slip does not take that long."""
NOISE_FRAMES = 30.0
"""The noise is learnt over so many frames."""
NOISE_START_DEG = 0.06
NOISE_MAX_DEG = 0.5
NOISE_TIMES = 6.0
"""A turn of so many standard deviations of what the sensor shows at rest is none of its noise."""
FIRM_TIMES = 2.5
"""A firm grip bears more load before it slips, and the gel winds up the further: a stiff pad up to 0.8 degrees."""
GROWTH_MAX = 4.0
"""However often it was tightened, no level grows beyond so many times its own."""
STEADY_DEG_S = 3.0
"""A frame that tells a faster turn is no place to rest at: the turn goes on, or this frame or one before it leapt."""
SWING_SHARE = 0.5
"""Arms stop with 2.5 m/s2, a quarter of gravity, and a gel without much damping answers with twice that."""


class MotionCase(Enum):
    """What a turn may be just now."""

    REST = "at rest"
    LIFT_OFF = "lifting off"
    MOVING = "moving"


@dataclass(frozen=True, slots=True)
class RestingPlace:
    """What is remembered for it.

    start_mm: height of the arm when watching began. moved_s: when it last moved, by its own account. near_deg: where
    the object rests, slowly followed; where it rested last while the arm moves. before_deg: the frame before, at rest.
    variance_deg2: of a turn at rest. measured_s: the newest frame used. anew: what the arm's motion has wound up until
    now is the new rest. rested_deg: where it rested before the arm's motions, for as long as none of them has turned
    it; None: the next rest says. aloft: the object has left the table since it was gripped or put down.
    """

    start_mm: float | None = None
    moved_s: float = -math.inf
    near_deg: float | None = None
    before_deg: float | None = None
    variance_deg2: float = NOISE_START_DEG**2
    measured_s: float = -math.inf
    case: MotionCase = MotionCase.MOVING
    anew: bool = False
    rested_deg: float | None = None
    aloft: bool = False

    @property
    def noise_deg(self) -> float:
        """One standard deviation of a turn at rest."""
        return min(math.sqrt(self.variance_deg2), NOISE_MAX_DEG)

    def handed_over(self, by_deg: float) -> RestingPlace:
        """The same places, as other fingers tell them."""
        return replace(
            self,
            near_deg=moved(self.near_deg, by_deg),
            before_deg=moved(self.before_deg, by_deg),
            rested_deg=moved(self.rested_deg, by_deg),
        )


def attend(
    alert: RestingPlace, fused: FusedEstimate, arm: ArmState | None, params: GuardParams, *, putting_down: bool = False
) -> RestingPlace:
    """What is known after one more look. Without an arm nobody knows what the load does: it may move."""
    if arm is not None:
        alert = replace(
            alert,
            start_mm=arm.height_mm if alert.start_mm is None else min(alert.start_mm, arm.height_mm),
            moved_s=arm.measured_at_s if arm.moving else alert.moved_s,
        )
    case = _case(alert, fused, arm)
    anew = case is not alert.case and (case is MotionCase.REST or alert.case is MotionCase.LIFT_OFF)
    rises = case is MotionCase.MOVING and alert.case is MotionCase.LIFT_OFF and not alert.aloft
    alert = replace(alert, case=case, anew=anew, aloft=(alert.aloft or rises) and not putting_down)
    if rises or putting_down:
        alert = replace(alert, rested_deg=None)
    elif case is MotionCase.REST and alert.rested_deg is None:
        alert = replace(alert, rested_deg=fused.rotation_deg)
    if fused.rotation_deg is None:
        return replace(alert, near_deg=None)
    if alert.near_deg is None or anew:
        steady = case is not MotionCase.REST or abs(fused.rate_deg_s or 0.0) <= STEADY_DEG_S
        near_deg = fused.rotation_deg if steady else None
        return replace(alert, near_deg=near_deg, before_deg=None, measured_s=fused.measured_at_s)
    if case is not MotionCase.REST:
        return replace(alert, measured_s=fused.measured_at_s)
    passed_s = fused.measured_at_s - alert.measured_s
    if passed_s <= 0.0:
        return alert
    near_deg = alert.near_deg
    away_deg = fused.rotation_deg - near_deg
    if abs(away_deg) > quick_level_deg(alert, params):
        return replace(alert, before_deg=None, measured_s=fused.measured_at_s)
    if alert.before_deg is not None:
        # From frame to frame: the way of a slow slip is none of the sensor's noise.
        leap_deg2 = 0.5 * (fused.rotation_deg - alert.before_deg) ** 2
        alert = replace(alert, variance_deg2=alert.variance_deg2 + (leap_deg2 - alert.variance_deg2) / NOISE_FRAMES)
    drift_deg = (1.0 - math.exp(-passed_s / FOLLOW_S)) * away_deg
    return replace(
        alert,
        near_deg=near_deg + drift_deg,
        before_deg=fused.rotation_deg,
        rested_deg=moved(alert.rested_deg, drift_deg),
        measured_s=fused.measured_at_s,
    )


def moved(place: float | None, by: float) -> float | None:
    """A place, if there is one."""
    return None if place is None else place + by


def quick_level_deg(alert: RestingPlace, params: GuardParams, *, firm: bool = False) -> float:
    """What counts as slip where nothing else should turn the object: at rest, or lifting off for the first time."""
    given_deg = params.tighten_at_rest_deg
    if alert.case is MotionCase.LIFT_OFF:
        given_deg = params.tighten_at_lift_off_deg * (FIRM_TIMES if firm else 1.0)
    return max(given_deg, NOISE_TIMES * alert.noise_deg)


def growth(episodes: int, params: GuardParams) -> float:
    """What the levels are multiplied by after so many episodes that were answered with force."""
    return min(params.tuning.threshold_growth**episodes, GROWTH_MAX)


def unsure_deg(sigma_deg: float, params: GuardParams) -> float:
    """The turn that may be no more than the estimate's error."""
    return min(params.tuning.threshold_sigmas * sigma_deg, params.tuning.sigma_threshold_max_deg)


def level_deg(sigma_deg: float, episodes: int, params: GuardParams) -> float:
    """The turn below which nothing counts as slip after so many episodes of it."""
    return max(params.tuning.tighten_in_motion_deg, unsure_deg(sigma_deg, params)) * growth(episodes, params)


def _case(alert: RestingPlace, fused: FusedEstimate, arm: ArmState | None) -> MotionCase:
    if arm is None or alert.start_mm is None:
        return MotionCase.MOVING
    rests = not arm.moving and fused.captured_at_s - alert.moved_s > SETTLE_S
    if rests:
        return MotionCase.REST
    return MotionCase.LIFT_OFF if arm.height_mm - alert.start_mm < LIFT_OFF_MM else MotionCase.MOVING
