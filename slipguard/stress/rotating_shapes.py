"""Shapes read twice, and shapes turned frame by frame through the whole pipeline."""

from __future__ import annotations

import math

from slipguard.perception.estimate import Orientation
from slipguard.stress.family import Notes
from slipguard.stress.map_checks import Map, patch_of, read
from slipguard.stress.product_functions import MAP_PX, Finger, Subject
from slipguard.stress.shapes import Distance, Pose, soft

STEP_DEG = 5.0
"""A fall turns an object by this much from frame to frame."""


def readings_of(maps: tuple[Map, Map], subject: Subject, notes: Notes) -> list[dict[str, Orientation]] | None:
    patches = [patch_of(one, 100.0, MAP_PX, subject, notes) for one in maps]
    return [read(one, subject, notes) for one in patches if one is not None] if None not in patches else None


def rotation_held(
    shape: Distance, start: Pose, end: Pose, subject: Subject, notes: Notes, noise: tuple[Map | None, Map | None]
) -> float | None:
    """Turn a shape frame by frame through the pipeline; the last answer's error, None where it declined.

    noise: roughness of the reference and of the last frame; those between carry the last one's.
    """
    finger = Finger(subject)
    rotation = end.angle_deg - start.angle_deg
    steps = max(1, math.ceil(abs(rotation) / STEP_DEG))
    error = None
    for k in range(steps + 1):
        part = k / steps
        pose = Pose(
            start.angle_deg + part * rotation,
            start.x_px + part * (end.x_px - start.x_px),
            start.y_px + part * (end.y_px - start.y_px),
            start.scale + part * (end.scale - start.scale),
            start.mirrored,
        )
        answer = notes.attempt("pipeline", finger.see, soft(shape, pose, noise[0] if k == 0 else noise[1]))
        if answer is None:
            return None
        notes.finite("pipeline", answer.orientation_deg, answer.rate_deg_s, *(answer.shift_mm or ()))
        error = notes.angle("pipeline", answer.angle_deg, answer.sigma_deg, part * rotation, axial=False)
    return error
