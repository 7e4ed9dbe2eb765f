"""How many frames later a slip is detected if frames are skipped."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field

import numpy as np

from slipguard.control.contact_motion import ZERO, ContactMotion
from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.datasets.rendered_grasps import FRAME_S, GraspFrame, RenderedGrasp
from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit

REST_S = 1.5
"""Long enough for frames to be skipped."""
RAMP_S = 0.1
SEEN_DEG, SEEN_MM = 0.3, 0.2
"""Motion beyond the noise that counts as slip."""
WAY_DEG, WAY_MM = 8.0, 2.7
"""The object moves this far, so that every slip is detected."""
ROTATION_RATES_DEG_S = (1.0, 4.0, 15.0, 60.0, 300.0)
TRANSLATION_RATES_MM_S = (1.0, 5.0)


@dataclass(frozen=True, slots=True)
class SlipOnset:
    """A slip after rest. rate: in degrees/s, or downwards in mm/s if `translates`."""

    object_name: str
    seed: int
    rate: float
    translates: bool = False

    def grasp(self) -> RenderedGrasp:
        """Render rest, then motion at a constant rate until the slip must be detected."""
        rng = np.random.default_rng([self.seed, round(100 * self.rate), self.translates])
        unit, held = random_unit(rng), find_object(self.object_name)
        camera = GelCamera(unit, seed=self.seed)
        background = camera.no_contact()
        x_mm, y_mm, start_deg = float(rng.uniform(-1, 1)), float(rng.uniform(0, 2)), float(rng.uniform(-180, 180))
        side, press_mm = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.6, 0.9)) * held.press_mm
        way = WAY_MM if self.translates else WAY_DEG
        moving_s = way / self.rate + RAMP_S / 2.0
        shots = []
        for index in range(round((REST_S + moving_s) / FRAME_S)):
            since_s = max(index * FRAME_S - REST_S, 0.0)
            ramped = since_s**2 / (2.0 * RAMP_S) if since_s < RAMP_S else since_s - RAMP_S / 2.0
            moved, speed = self.rate * ramped, self.rate * min(since_s / RAMP_S, 1.0)
            if self.translates:
                view = GelView(self.object_name, x_mm, y_mm - moved, start_deg, press_mm, vy_mm_s=-speed)
            else:
                rotated = side * moved
                view = GelView(self.object_name, x_mm, y_mm, start_deg + rotated, press_mm, rate_deg_s=side * speed)
            rotation_deg = 0.0 if self.translates else side * moved
            shots.append(
                GraspFrame(Frame(camera.draw(view), index * FRAME_S, index), True, rotation_deg, since_s > 0.0, None)
            )
        return RenderedGrasp(
            self.object_name, held.axial, background, unit.noise_bgr, unit.px_per_mm, tuple(shots), self.rate
        )


def first_detection(process: Callable[[Frame], Estimate], frames: Iterable[Frame]) -> int | None:
    """Return the index of the frame at which the controller detects slip with this finger only; None if never."""
    watch = SlipWatch()
    for index, frame in enumerate(frames):
        fused = fuse(process(frame), None)
        if fused is None:
            continue
        if watch.slips(fused):
            return index
    return None


@dataclass(slots=True)
class SlipWatch:
    """The motion of an object that should be at rest, and how far it has moved beyond the noise."""

    motion: ContactMotion = field(default_factory=ContactMotion)
    way: tuple[float, float, float] = ZERO

    def slips(self, fused: FusedEstimate) -> bool:
        """Return whether the object has moved visibly by this estimate."""
        self.motion, moved = self.motion.followed(fused, rests=True, settled=True, sure=False)
        self.way = (self.way[0] + moved[0], self.way[1] + moved[1], self.way[2] + moved[2])
        return abs(self.way[0]) > SEEN_DEG or math.hypot(*self.way[1:]) > SEEN_MM or fused.slides


def detection_delay(skipping: int | None, measuring: int | None, frames: int) -> int | None:
    """Return how many frames later slip is detected if frames are skipped, negative if earlier.

    A slip that is not detected with skipping counts as detected after the last frame. None if it is not detected
    without skipping.
    """
    return None if measuring is None else (frames if skipping is None else skipping) - measuring
