"""Rendered grasps of known turn: no contact, closing, holding still, turning while force and place change.

Quicker than the whole simulated cell and the same for every pipeline: what `slipguard bench` measures errors on.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.sim.gel import GelCamera
from slipguard.sim.label import label
from slipguard.sim.objects import SimObject, get
from slipguard.sim.unit import Light, Unit, random_unit
from slipguard.sim.view import GelView

FRAME_S = 1.0 / 60.0
EMPTY_FRAMES, CLOSING_FRAMES, STILL_FRAMES, END_FRAMES = 6, 6, 10, 8
TURN_DEG = (30.0, 60.0)
RATE_DEG_S = (40.0, 300.0)
"""Highest rate of the turn: a slow slip to a fall."""
PLACE_MM = (2.2, 3.5)
"""The contact lies within this of the picture's middle, right and up: the frame cuts long and wide ones."""
SHIFT_MM = 1.2


@dataclass(frozen=True, slots=True, eq=False)
class Shot:
    """One frame and its truth. turn_deg: since the object was held still; mask: (320, 240) uint8, the labelled contact.

    mask is None where it was not asked for; compared: part of the turn's error (after the reference, in contact).
    """

    frame: Frame
    contact: bool
    turn_deg: float
    compared: bool
    mask: NDArray[np.uint8] | None


@dataclass(frozen=True, slots=True, eq=False)
class Sequence:
    """One grasp of one object by one sensor unit. background: its no-contact image, noise_bgr: as calibrated."""

    object_name: str
    readable: bool
    background: NDArray[np.uint8]
    noise_bgr: tuple[float, float, float]
    px_per_mm: float
    shots: tuple[Shot, ...]


def sequence(object_name: str, seed: int, with_masks: bool = False) -> Sequence:
    """Render one grasp; the same for the same name and seed. Raises InputError for an unknown object."""
    rng = np.random.default_rng(np.random.SeedSequence([seed, *object_name.encode()]))
    thing = get(object_name)
    unit = Unit.default() if seed % 2 == 0 else random_unit(rng)
    camera = GelCamera(unit, seed=int(rng.integers(2**31)))
    background = camera.no_contact()
    camera.set_light(Light(1.0, tuple(rng.uniform(-5.0, 5.0, 3)), tuple(rng.uniform(-1.5, 1.5, 3))))
    shots = []
    for index, (view, turn, compared) in enumerate(_views(thing, rng)):
        truth = camera.draw_with_truth(view)
        mask = label(truth) if with_masks else None
        frame = Frame(truth.image, index * FRAME_S, index)
        shots.append(Shot(frame, view.depth_mm > 0.0, turn, compared, mask))
    return Sequence(object_name, thing.axial, background, unit.noise_bgr, unit.px_per_mm, tuple(shots))


def _views(thing: SimObject, rng: np.random.Generator) -> Iterator[tuple[GelView, float, bool]]:
    """Pose, turn and whether the turn counts, frame by frame."""
    start_deg = float(rng.uniform(-180.0, 180.0))
    x, y = float(rng.uniform(-1, 1) * PLACE_MM[0]), float(rng.uniform(-1, 1) * PLACE_MM[1])
    total = float(rng.uniform(*TURN_DEG) * rng.choice([-1.0, 1.0]))
    peak = float(math.exp(rng.uniform(math.log(RATE_DEG_S[0]), math.log(RATE_DEG_S[1]))))
    direction = float(rng.uniform(-math.pi, math.pi))
    shift_x, shift_y = SHIFT_MM * rng.uniform(0, 1) * np.array([math.cos(direction), math.sin(direction)])
    press, pressed = thing.press_mm * rng.uniform(0.45, 0.75), thing.press_mm * rng.uniform(0.8, 1.05)
    duration_s = max(1.5 * abs(total) / peak, 4 * FRAME_S)  # a smooth step's peak is 1.5 times its mean
    turning = math.ceil(duration_s / FRAME_S)
    name = thing.name
    for _ in range(EMPTY_FRAMES):
        yield GelView(name), 0.0, False
    for k in range(1, CLOSING_FRAMES + 1):
        yield GelView(name, x, y, start_deg, press * k / CLOSING_FRAMES), 0.0, False
    for _ in range(STILL_FRAMES):
        yield GelView(name, x, y, start_deg, press), 0.0, False
    for k in range(1, turning + END_FRAMES + 1):
        part = min(k / turning, 1.0)
        done = part * part * (3.0 - 2.0 * part)
        rate = total * 6.0 * part * (1.0 - part) / duration_s
        depth = press + (pressed - press) * min(k / (turning + END_FRAMES), 1.0)
        yield (
            GelView(name, x + done * shift_x, y + done * shift_y, start_deg + done * total, depth, rate_deg_s=rate),
            done * total,
            True,
        )
    yield GelView(name), 0.0, False
