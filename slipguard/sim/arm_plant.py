"""An arm that moves up and down: trapezoidal speed profiles in closed form, and stops with finite deceleration.

A motion is a list of segments of constant acceleration, so height, speed and acceleration are exact at any time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from slipguard.devices import ArmState


@dataclass(frozen=True, slots=True)
class ArmModel:
    """Limits of the arm. URScript's movel default is 1200 mm/s2; 250 mm/s is the usual collaborative cap.

    stop_mm_s2: deceleration of a commanded, protective or emergency stop; 250 mm/s ends in 100 ms (50-150 ms).
    """

    acceleration_mm_s2: float = 1200.0
    stop_mm_s2: float = 2500.0
    speed_min_mm_s: float = 1.0
    speed_max_mm_s: float = 250.0
    height_min_mm: float = 0.0
    height_max_mm: float = 800.0


@dataclass(frozen=True, slots=True)
class MotionSegment:
    """Constant acceleration from `start_s` until the next segment."""

    start_s: float
    height_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float


@dataclass(frozen=True, slots=True)
class ArmPlant:
    """The arm's motion. segments: in order of time, the last one at rest."""

    segments: tuple[MotionSegment, ...] = (MotionSegment(-math.inf, 0.0, 0.0, 0.0),)


@dataclass(frozen=True, slots=True)
class ArmPose:
    """Height, speed and acceleration at one moment, up positive."""

    height_mm: float
    speed_mm_s: float
    acceleration_mm_s2: float
    moving: bool


def pose(plant: ArmPlant, now_s: float) -> ArmPose:
    last = plant.segments[-1]
    if now_s >= last.start_s:
        return ArmPose(last.height_mm, 0.0, 0.0, False)
    segment = plant.segments[0]
    for following in plant.segments[1:]:
        if now_s < following.start_s:
            break
        segment = following
    t = max(now_s - segment.start_s, 0.0)
    a = segment.acceleration_mm_s2
    return ArmPose(segment.height_mm + t * (segment.speed_mm_s + 0.5 * a * t), segment.speed_mm_s + a * t, a, True)


def order_lift(
    plant: ArmPlant, model: ArmModel, now_s: float, height_mm: float, speed_mm_s: float
) -> tuple[ArmPlant, float]:
    """Return the motion by `height_mm` from here (negative: down), within the height limits, and the speed applied.

    A present motion is replaced without a jump in speed.
    """
    speed_mm_s = min(max(speed_mm_s, model.speed_min_mm_s), model.speed_max_mm_s)
    here = pose(plant, now_s)
    goal_mm = min(max(here.height_mm + height_mm, model.height_min_mm), model.height_max_mm)
    a = model.acceleration_mm_s2
    start = MotionSegment(now_s, here.height_mm, here.speed_mm_s, 0.0)
    segments: list[MotionSegment] = []
    distance_mm = goal_mm - here.height_mm
    braking_mm = here.speed_mm_s * abs(here.speed_mm_s) / (2 * a)
    # Moving away from the goal, or unable to stop before it: brake first, then start from rest.
    if here.speed_mm_s and (distance_mm * here.speed_mm_s < 0 or abs(braking_mm) > abs(distance_mm)):
        start = _append(segments, start, -math.copysign(a, here.speed_mm_s), abs(here.speed_mm_s) / a, end_speed=0.0)
    distance_mm = goal_mm - start.height_mm
    sign = math.copysign(1.0, distance_mm)
    entry = abs(start.speed_mm_s)
    if abs(distance_mm) > 1e-9:
        top = min(speed_mm_s, math.sqrt(a * abs(distance_mm) + 0.5 * entry * entry))
        change = math.copysign(a, top - entry)
        start = _append(segments, start, sign * change, abs(top - entry) / a, end_speed=sign * top)
        cruise_mm = abs(goal_mm - start.height_mm) - top * top / (2 * a)
        start = _append(segments, start, 0.0, max(cruise_mm, 0.0) / top, end_speed=sign * top)
        start = _append(segments, start, -sign * a, top / a, end_speed=0.0)
    segments.append(MotionSegment(start.start_s, goal_mm, 0.0, 0.0))
    return ArmPlant(tuple(segments)), speed_mm_s


def order_stop(plant: ArmPlant, model: ArmModel, now_s: float) -> ArmPlant:
    """Return the motion that brakes to rest; at rest nothing changes."""
    here = pose(plant, now_s)
    if not here.moving:
        return plant
    segments: list[MotionSegment] = []
    start = MotionSegment(now_s, here.height_mm, here.speed_mm_s, 0.0)
    decel = model.stop_mm_s2
    end = _append(segments, start, -math.copysign(decel, here.speed_mm_s), abs(here.speed_mm_s) / decel, end_speed=0.0)
    return ArmPlant((*segments, end))


def _append(
    segments: list[MotionSegment], start: MotionSegment, acceleration: float, seconds: float, end_speed: float
) -> MotionSegment:
    """Append a segment of `seconds`, none if 0, and return the state at its end, the start of the next."""
    if seconds <= 0.0:
        return start
    segments.append(MotionSegment(start.start_s, start.height_mm, start.speed_mm_s, acceleration))
    height_mm = start.height_mm + seconds * (start.speed_mm_s + 0.5 * acceleration * seconds)
    return MotionSegment(start.start_s + seconds, height_mm, end_speed, 0.0)


def report(plant: ArmPlant, now_s: float, protective_stop: bool = False, emergency_stop: bool = False) -> ArmState:
    here = pose(plant, now_s)
    return ArmState(
        height_mm=here.height_mm,
        speed_mm_s=here.speed_mm_s,
        moving=here.moving,
        protective_stop=protective_stop,
        emergency_stop=emergency_stop,
        measured_at_s=now_s,
        position_mm=(0.0, 0.0, here.height_mm),
        orientation_rad=(0.0, math.pi, 0.0),  # the fingers point down
    )
