"""The table of perturbations that `slipguard stress` applies to the same grasps."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import cast

import cv2
import numpy as np

from slipguard.datasets.effect_scenes import EFFECTS, EffectName, effect_cases, render_effect
from slipguard.datasets.rendered_grasps import FRAME_S
from slipguard.perception.patch import MEAN_MIN
from slipguard.stress.grasps import GRASPS, ROTATED_FRAMES, STILL_FRAMES, Image, Map, StressedGrasp, rotated_grasp
from slipguard.stress.image_distortions import DISTORTIONS, Distortion, malformed, unrelated_image
from slipguard.stress.masks import degenerate_masks

Perturb = Callable[[float, np.random.Generator], StressedGrasp]
"""(level, random numbers) to a perturbed grasp."""
STRENGTHS = (0.03, 0.06, 0.12, 0.25, 0.5, 0.75, 1.0)
NOISE_LEVELS = (0.0, 2.0, 4.0, 8.0, 16.0, 32.0)
GAPS_S = (2.0 * FRAME_S, 0.05, 0.1, 0.25, 0.5, 2.0)
STEPS_S = (0.0, 1e-12, 1e-9, 1e-6, 1e-3, FRAME_S, 0.1, 0.25, 1.0, 60.0, 1e6, 1e12, -1e-9, -FRAME_S, -1.0, -1e6)
INVALID_TIMES_S = (np.nan, np.inf, -np.inf)
BAD_PROBABILITIES = (np.nan, np.inf, -np.inf, 3e38, -3e38, 1e-40, -1e-40, -0.0)
BAD_SHARES = (0.0005, 0.01, 0.1, 0.5, 1.0)
SCALES = (1e-40, 1e-20, 1e-6, 0.1, 10.0, 1e6, 1e20, 1e38)
SWINGS = 5
MASKS = tuple(degenerate_masks().values())
EFFECT_LEVELS: dict[EffectName, tuple[float, ...]] = {
    "clean": (1.0,),
    "rocking": (1.0, 2.0, 3.0, 4.0, 6.0, 8.0, 10.0, 12.0),
    "memory": (0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.8),
    "partial slip": (1.0, 2.0, 3.0, 5.0, 7.0, 9.0, 13.0, 17.0),
    "periodic": (300.0, 1_000.0, 3_000.0, 7_500.0, 12_000.0, 20_000.0, 30_000.0, 50_000.0),
}
"""Sizes of the effects, as in `effect_scenes.LEVELS`, and beyond."""
TRIALS_PER_LEVEL = 72
GOLDEN = 0.618034


@dataclass(frozen=True, slots=True)
class Perturbation:
    """One row of the table.

    Attributes:
        levels: Sizes; `level` spreads the trials over them.
        unit: Of the levels, for the axis of the plot; "" if they are not plotted.
        sweep: Whether the levels go on until estimates are confidently wrong. That is reported, and is no failure.
        least_answered: Smallest allowed share of estimates that are not declined: who always declines is never wrong.
        drift: Whether the rotation at the end is compared with that at the begin.
    """

    perturb: Perturb
    levels: tuple[float, ...]
    unit: str = ""
    sweep: bool = False
    least_answered: float = 0.0
    drift: bool = False

    def level(self, seed: int) -> float:
        """Return the level of a trial; few consecutive seeds already cover small and large ones."""
        return self.levels[int(len(self.levels) * (seed * GOLDEN % 1.0))]

    @property
    def trials(self) -> int:
        """Number of trials in the full list."""
        return len(self.levels) * TRIALS_PER_LEVEL


def _grasp(rng: np.random.Generator) -> StressedGrasp:
    return rotated_grasp(int(rng.integers(GRASPS)))


def _at_rest(grasp: StressedGrasp, frames: int) -> StressedGrasp:
    """Return the frames before the rotation, repeated."""
    return grasp.in_order([k % STILL_FRAMES for k in range(frames)])


def _distorted(distort: Distortion, level: float, rng: np.random.Generator) -> StressedGrasp:
    """Distort during calibration already, after the reference was taken, or differently in each frame."""
    grasp, draw = _grasp(rng), int(rng.integers(2**31))

    def permanently(image: Image) -> Image:
        return distort(image, level, np.random.default_rng(draw))

    when = int(rng.integers(3))
    if when == 0:
        assert grasp.background is not None
        changed = grasp.with_frames(permanently)
        noise = _measured_noise(changed.frames[:STILL_FRAMES])
        return replace(changed, background=permanently(grasp.background), noise_bgr=noise)
    if when == 1:
        return grasp.with_frames(permanently, STILL_FRAMES)
    return grasp.with_frames(lambda image: distort(image, level, rng))


def _measured_noise(still: Sequence[Image]) -> tuple[float, float, float]:
    """Return the noise as the calibration measures it, from differences of consecutive frames."""
    b, g, r = np.diff(np.stack(still).astype(np.float32), axis=0).std(axis=(0, 1, 2)) / np.sqrt(2.0)
    return float(b), float(g), float(r)


def _noisy(level: float, rng: np.random.Generator) -> StressedGrasp:
    return _grasp(rng).with_frames(lambda image: DISTORTIONS["noise"](image, level / 64.0, rng))


def _uncalibrated(level: float, rng: np.random.Generator) -> StressedGrasp:
    return replace(_grasp(rng), background=None, noise_bgr=None)


def _foreign(make: Callable[[np.random.Generator], object], level: float, rng: np.random.Generator) -> StressedGrasp:
    """Follow a reference with images that show no gel, or with objects that are no images."""
    grasp = _grasp(rng).with_frames(lambda image: cast(Image, make(rng)), STILL_FRAMES)
    return replace(grasp, rotations_deg=(*grasp.rotations_deg[:STILL_FRAMES], *[None] * ROTATED_FRAMES))


def _masked(level: float, rng: np.random.Generator) -> StressedGrasp:
    """Let the network find a degenerate mask: as 0 and 1, just above the thresholds, or blurred."""
    mask = np.flip(MASKS[int(level)], tuple(axis for axis in (0, 1) if rng.random() < 0.5)).astype(np.float32)
    above = np.nextafter(np.float32(MEAN_MIN), np.float32(1.0))
    style = int(rng.integers(3))
    shown = mask if style == 0 else np.where(mask > 0, above, np.float32(0.5)) if style == 1 else _blurred(mask)
    return replace(_at_rest(_grasp(rng), 8), change_map=lambda found: np.ascontiguousarray(shown, np.float32))


def _blurred(mask: Map) -> Map:
    return np.asarray(cv2.GaussianBlur(mask, (0, 0), 1.0), np.float32)


def _odd_probabilities(level: float, rng: np.random.Generator) -> StressedGrasp:
    value = BAD_PROBABILITIES[int(rng.integers(len(BAD_PROBABILITIES)))]

    def change(found: Map) -> Map:
        return np.where(rng.random(found.shape) < level, np.float32(value), found)

    return replace(_at_rest(_grasp(rng), 8), change_map=change)


def _scaled_probabilities(level: float, rng: np.random.Generator) -> StressedGrasp:
    return replace(_grasp(rng), change_map=lambda found: found * np.float32(level))


def _odd_times(level: float, rng: np.random.Generator) -> StressedGrasp:
    """Let the clock leap, stop, run backwards or be missing, while the object rests. level: its first time."""
    now_s, times = level, []
    for _ in range(12):
        now_s += float(rng.choice(STEPS_S))
        times.append(float(rng.choice(INVALID_TIMES_S)) if rng.random() < 0.15 else now_s)
    return _grasp(rng).in_order([k % STILL_FRAMES for k in range(12)], times)


def _unseen(level: float, rng: np.random.Generator) -> StressedGrasp:
    """Rotate the object during a gap of `level` seconds."""
    first = STILL_FRAMES + int(rng.integers(ROTATED_FRAMES))
    order = [*range(STILL_FRAMES), first, first]
    times_s = [k * FRAME_S + (level if k >= STILL_FRAMES else 0.0) for k in range(len(order))]
    return _grasp(rng).in_order(order, times_s)


def _swinging(level: float, rng: np.random.Generator) -> StressedGrasp:
    """Rotate to and fro."""
    there = list(range(STILL_FRAMES, STILL_FRAMES + ROTATED_FRAMES))
    order = [*range(STILL_FRAMES), *[*there, *there[-2::-1], STILL_FRAMES - 1] * SWINGS]
    grasp = _grasp(rng).in_order(order)
    return grasp.with_frames(lambda image: DISTORTIONS["noise"](image, level / 64.0, rng))


def _round(level: float, rng: np.random.Generator) -> StressedGrasp:
    return rotated_grasp(int(rng.integers(GRASPS)), visible=False)


def _effect(effect: EffectName, level: float, rng: np.random.Generator) -> StressedGrasp:
    cases = effect_cases(effect)
    seed, case = int(rng.integers(2**31)), cases[int(rng.integers(len(cases)))]
    return StressedGrasp.of(render_effect(effect, case, seed, level))


PERTURBATIONS: dict[str, Perturbation] = {
    "camera noise": Perturbation(_noisy, NOISE_LEVELS, "camera noise in gray levels (1 sd)", least_answered=0.3),
    **{name: Perturbation(partial(_distorted, one), STRENGTHS, "strength") for name, one in DISTORTIONS.items()},
    "no calibration": Perturbation(_uncalibrated, (0.0,)),
    "no gel image": Perturbation(partial(_foreign, unrelated_image), (0.0,)),
    "no image": Perturbation(partial(_foreign, malformed), (0.0,)),
    "degenerate mask": Perturbation(_masked, tuple(float(k) for k in range(len(MASKS))), least_answered=0.15),
    "odd probability": Perturbation(_odd_probabilities, BAD_SHARES),
    "scaled output": Perturbation(_scaled_probabilities, SCALES),
    "odd clock": Perturbation(_odd_times, (0.0, 1.0, 1e3, 1e6, 1e9), least_answered=0.3),
    "gap": Perturbation(_unseen, GAPS_S, "gap in seconds", least_answered=0.3),
    "swing": Perturbation(_swinging, (0.5, 1.0, 2.0), least_answered=0.9, drift=True),
    "round contact": Perturbation(_round, (0.0,)),
    **{
        name: Perturbation(partial(_effect, name), EFFECT_LEVELS[name], f"{name}: size", sweep=True, least_answered=0.4)
        for name in EFFECTS
    },
}
