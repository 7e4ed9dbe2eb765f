"""Rendered grasps with one effect each: none, a tilted object, gel memory, partial slip, periodic texture.

Like `rendered_grasps`, but the imprint does what a rigid one in the image plane does not. The truth is the object's
rotation in the image plane, and the shift of its point at the image center.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cache
from typing import Literal, get_args

import numpy as np

from slipguard.datasets.rendered_grasps import FRAME_S, GraspFrame, RenderedGrasp
from slipguard.devices import Frame
from slipguard.errors import InputError
from slipguard.sim.catalogue import find_object, object_names
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_effects import GelEffects, GelMemory
from slipguard.sim.gel_view import GelView
from slipguard.sim.height_raster import HeightRaster
from slipguard.sim.sensor_unit import random_unit
from slipguard.sim.shaft import Shaft

EffectName = Literal["clean", "rocking", "memory", "partial slip", "periodic"]
EFFECTS: tuple[EffectName, ...] = get_args(EffectName)
EMPTY_FRAMES, CLOSING_FRAMES, STILL_FRAMES, MOVING_FRAMES = 3, 5, 8, 36
ROLLING = ("banana", "hammer", "pen")
"""Training objects of the network that roll easily; they are test objects of this module all the same."""
SHAFTS = {
    "ribs_0.8": Shaft(pitch_mm=0.8, groove_mm=0.3),
    "ribs_1.4": Shaft(pitch_mm=1.4, groove_mm=0.4, radius_mm=7.0),
    "ribs_2.0": Shaft(pitch_mm=2.0, groove_mm=0.5, radius_mm=4.0),
    "thread_m8": Shaft(pitch_mm=1.25, radius_mm=4.0, threaded=True),
    "thread_m16": Shaft(pitch_mm=2.0, radius_mm=8.0, threaded=True),
    "plain_end": Shaft(end_mm=3.0),
}
PERIODIC = ("gear", "nut", "cap", *SHAFTS)

LEVELS: dict[EffectName, tuple[float, float]] = {
    "clean": (1.0, 1.0), "rocking": (2.0, 10.0), "memory": (0.1, 0.4), "partial slip": (2.0, 9.0),
    "periodic": (300.0, 20_000.0),
}  # fmt: skip
"""Range of an effect's size: tilt (degrees), share of the past, lag (degrees), acceleration (degrees/s2; for shafts
mm/s2, up to 1 g). A clean contact has none."""
ROTATION_DEG = (4.0, 20.0)
SHEAR_MM = 0.6
FADE_S = (0.5, 20.0)
GRAVITY_MM_S2 = 9810.0
SLIDE_MM, FAST_ROTATION_DEG = 30.0, 150.0


@dataclass(frozen=True, slots=True)
class _Pose:
    """Object in one frame of the motion, against its pose when still. shift_mm: right and up."""

    rotation_deg: float = 0.0
    rate_deg_s: float = 0.0
    shift_mm: tuple[float, float] = (0.0, 0.0)
    speed_mm_s: tuple[float, float] = (0.0, 0.0)
    effects: GelEffects | None = None
    imprint_lag_deg: float = 0.0


def effect_cases(effect: EffectName) -> tuple[str, ...]:
    """Return the test objects of an effect."""
    if effect == "periodic":
        return PERIODIC
    readable = tuple(name for name in object_names("test") if name != "ring")
    return (*readable, *ROLLING) if effect == "rocking" else readable


def render_effect(effect: EffectName, case: str, seed: int, level: float | None = None) -> RenderedGrasp:
    """Return one rendered grasp with an effect, deterministic for its arguments.

    Args:
        case: a name from `effect_cases`, or any catalogue object.
        level: size of the effect; None: at random in `LEVELS`.

    Raises:
        InputError: unknown effect or object.
    """
    if effect not in EFFECTS:
        raise InputError(f"no effect {effect!r}; there are: {', '.join(EFFECTS)}")
    rng = np.random.default_rng(np.random.SeedSequence([seed, *f"{effect}/{case}".encode()]))
    drawn = math.exp(rng.uniform(*np.log(LEVELS[effect])))
    level = drawn if level is None else level
    raster = shaft_raster(case) if case in SHAFTS else None
    press_mm = 0.8 if raster is not None else find_object(case).press_mm
    press_mm *= float(rng.uniform(0.5, 0.8))
    unit = random_unit(rng)
    # A gel forgets within its time constant; half of them keep what they had for the whole grasp.
    fade_s = math.inf if rng.random() < 0.5 else math.exp(rng.uniform(*np.log(FADE_S)))
    memory = GelMemory(level, fade_s, FRAME_S) if effect == "memory" else None
    camera = GelCamera(unit, seed=int(rng.integers(2**31)), memory=memory)
    x_mm, y_mm = rng.uniform(-1.0, 1.0), rng.uniform(-1.5, 1.5)
    still = GelView("" if raster is not None else case, x_mm, y_mm, float(rng.uniform(-180.0, 180.0)), press_mm)
    shots: list[GraspFrame] = []

    def add(view: GelView, pose: _Pose, *, compared: bool) -> None:
        image = camera.draw(view, raster=raster)
        frame = Frame(image, len(shots) * FRAME_S, len(shots))
        moved = replace(view, angle_deg=still.angle_deg + pose.rotation_deg)  # the object, not its imprint
        shift_mm = moved.center_shift_mm(still)
        shots.append(GraspFrame(frame, view.depth_mm > 0.0, pose.rotation_deg, compared, None, shift_mm))

    at_rest = _Pose()
    for _ in range(EMPTY_FRAMES):
        add(replace(still, depth_mm=0.0), at_rest, compared=False)
    for k in range(1, CLOSING_FRAMES + STILL_FRAMES + 1):
        add(replace(still, depth_mm=press_mm * min(k / CLOSING_FRAMES, 1.0)), at_rest, compared=False)
    camera.settle()
    for pose in _MOTIONS[effect](rng, level, still.angle_deg, raster is not None):
        view = replace(
            still,
            x_mm=still.x_mm + pose.shift_mm[0],
            y_mm=still.y_mm + pose.shift_mm[1],
            angle_deg=still.angle_deg + pose.rotation_deg - pose.imprint_lag_deg,
            vx_mm_s=pose.speed_mm_s[0],
            vy_mm_s=pose.speed_mm_s[1],
            rate_deg_s=pose.rate_deg_s,
            effects=pose.effects,
        )
        add(view, pose, compared=True)
    readable = raster is None and find_object(case).axial
    return RenderedGrasp(case, readable, camera.no_contact(), unit.noise_bgr, unit.px_per_mm, tuple(shots))


@cache
def shaft_raster(name: str) -> HeightRaster:
    return SHAFTS[name].raster()


def _smooth(part: float) -> float:
    part = min(max(part, 0.0), 1.0)
    return part * part * (3.0 - 2.0 * part)


def _slow_rotations(rng: np.random.Generator) -> list[tuple[float, float]]:
    """Return rotation and rate in every frame: to one side, back past the start, and rest."""
    side = float(rng.choice([-1.0, 1.0]))
    out, back = (float(rng.uniform(*ROTATION_DEG)) for _ in range(2))
    angles = [
        side * (out * _smooth(k / 14) - (out + back) * _smooth((k - 14) / 16)) for k in range(1, MOVING_FRAMES + 1)
    ]
    return [(angle, (angle - before) / FRAME_S) for before, angle in zip([0.0, *angles], angles, strict=False)]


def _rocking(rng: np.random.Generator, level: float, start_deg: float, is_shaft: bool) -> Iterator[_Pose]:
    """Tilt to one side and to the other; half of the objects also rotate in the image plane."""
    direction = float(rng.uniform(-math.pi, math.pi))
    rotates = float(rng.random() < 0.5)
    for k, (rotation_deg, rate_deg_s) in enumerate(_slow_rotations(rng), 1):
        tilt = level * (_smooth(k / 12) - 2.0 * _smooth((k - 14) / 20))
        effects = GelEffects(pitch_deg=tilt * math.cos(direction), roll_deg=tilt * math.sin(direction))
        yield _Pose(rotates * rotation_deg, rotates * rate_deg_s, effects=effects)


def _rotating(rng: np.random.Generator, level: float, start_deg: float, is_shaft: bool) -> Iterator[_Pose]:
    for rotation_deg, rate_deg_s in _slow_rotations(rng):
        yield _Pose(rotation_deg, rate_deg_s)


def _partial_slip(rng: np.random.Generator, level: float, start_deg: float, is_shaft: bool) -> Iterator[_Pose]:
    """Let the rim lag behind the object while the sticking middle shrinks; or the middle, if it sticks to the gel."""
    of_middle = rng.random() < 0.5
    shear = float(rng.uniform(0.0, SHEAR_MM))
    direction = float(rng.uniform(-math.pi, math.pi))
    for k, (rotation_deg, rate_deg_s) in enumerate(_slow_rotations(rng), 1):
        lag_deg = math.copysign(min(abs(rotation_deg), level), rotation_deg)
        stick_mm = (2.0 if of_middle else 5.0) * (1.0 - 0.5 * _smooth(k / MOVING_FRAMES))
        loaded = shear * _smooth(k / 14)
        effects = GelEffects(
            twist_deg=-lag_deg if of_middle else lag_deg,
            shear_mm=(loaded * math.cos(direction), loaded * math.sin(direction)),
            stick_mm=stick_mm,
        )
        pose = _Pose(rotation_deg, rate_deg_s, effects=effects)
        # The middle lags if the whole imprint does and its rim is twisted forward again.
        yield replace(pose, imprint_lag_deg=lag_deg) if of_middle else pose


def _periodic(rng: np.random.Generator, level: float, start_deg: float, is_shaft: bool) -> Iterator[_Pose]:
    """Accelerate from rest: a shaft along its axis, anything else in rotation."""
    side = float(rng.choice([-1.0, 1.0]))
    rest = int(rng.integers(2, 6))
    along = (math.cos(math.radians(start_deg)), math.sin(math.radians(start_deg)))
    level = min(level, GRAVITY_MM_S2) if is_shaft else level
    for k in range(1, MOVING_FRAMES + 1):
        since_s = max(k - rest, 0) * FRAME_S
        way, speed = side * 0.5 * level * since_s**2, side * level * since_s
        if abs(way) > (SLIDE_MM if is_shaft else FAST_ROTATION_DEG):
            return
        if is_shaft:
            shift, speeds = (way * along[0], way * along[1]), (speed * along[0], speed * along[1])
            yield _Pose(shift_mm=shift, speed_mm_s=speeds)
        else:
            yield _Pose(way, speed)


_MOTIONS: dict[EffectName, Callable[[np.random.Generator, float, float, bool], Iterator[_Pose]]] = {
    "clean": _rotating, "rocking": _rocking, "memory": _rotating, "partial slip": _partial_slip, "periodic": _periodic,
}  # fmt: skip
