"""How far to trust the turn by relief: the constants of its sigma, fitted to rendered turns of the training objects.

`python -m slipguard.lab.sigma_fit [--grasps N] [--model FILE]` prints what is in use, what fits, and how many errors
lie within one and two sigmas of either. To be run again when the network or the renderer has changed; the constants
stand in `slipguard.perception.texture`.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from slipguard.lab import sequences
from slipguard.perception import texture
from slipguard.perception.regions import Patch, find_patch
from slipguard.perception.relief import ReliefReader
from slipguard.perception.segment import Segmenter
from slipguard.perception.texture import TextureFit, TexturePose, faintness, fit, grown_deg, make_texture, sigma_deg
from slipguard.sim.objects import names

SEED = 7400
FRAME_PX = 2.0
MIN_AREA_PX = 200.0
DEGREES_OF_FREEDOM = 5.0
"""Errors have heavier tails than a Gaussian: a single bad grasp must not set the constants for all."""
STEPS = (0.4, 0.15, 0.05, 0.02)
HEADROOM = 1.25
"""Sigmas are made larger than what fits best by this: two sigmas shall hold 93 % of the errors of unknown objects."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One measured turn: its error, and the fit that told it."""

    grasp: str
    error_deg: float
    answer: TextureFit


def samples(grasps: Iterable[sequences.Sequence], segmenter: Segmenter) -> Iterator[Sample]:
    """Every turn by relief since the last still frame, frame after frame, of some grasps."""
    for number, grasp in enumerate(grasps):
        start = next((k for k, shot in enumerate(grasp.shots) if shot.compared), 0) - 1
        reader = ReliefReader(grasp.background)
        patch = _patch(segmenter, grasp, start)
        if start < 0 or patch is None:
            continue
        image = grasp.shots[start].frame.image
        reader.learn(image, patch)
        reference = make_texture(reader.read(image, patch), patch)
        pose, rate = TexturePose(), 0.0
        for k in range(start + 1, len(grasp.shots)):
            patch = _patch(segmenter, grasp, k)
            if reference is None or patch is None or not grasp.shots[k].compared:
                continue
            relief = reader.read(grasp.shots[k].frame.image, patch)
            answer = fit(reference, relief, replace(pose, turn_deg=pose.turn_deg + rate))
            if answer.declined is not None:
                continue
            rate, pose = answer.pose.turn_deg - pose.turn_deg, answer.pose
            error = answer.pose.turn_deg - grasp.shots[k].turn_deg
            yield Sample(f"{grasp.object_name} {number}", error, answer)


def fitted(found: Sequence[Sample]) -> tuple[float, float, float]:
    """The shares of spread, growth and misfit in sigma under which the errors are likeliest, every grasp alike."""
    error, parts, weight = _table(found)
    best = np.log(np.array([texture.SPREAD_SIGMA, texture.GROWTH_SIGMA, texture.MISFIT_SIGMA]))
    cost = _surprise(best, error, parts, weight)
    for step in STEPS:
        improved = True
        while improved:
            improved = False
            for axis in range(3):
                for way in (-step, step):
                    other = best.copy()
                    other[axis] += way
                    now = _surprise(other, error, parts, weight)
                    if now < cost - 1e-6:
                        best, cost, improved = other, now, True
    spread, growth, misfit = (HEADROOM * np.exp(best)).tolist()
    return spread, growth, misfit


def within(found: Sequence[Sample], sigmas: float) -> float:
    """Share of the errors, every grasp alike, within so many sigmas as they are in use."""
    _, _, weight = _table(found)
    inside = np.array([abs(one.error_deg) <= sigmas * sigma_deg(one.answer) for one in found])
    return float(weight @ inside)


def _patch(segmenter: Segmenter, grasp: sequences.Sequence, index: int) -> Patch | None:
    probability = segmenter.segment(grasp.shots[index].frame.image, grasp.background)
    frame_px = FRAME_PX * 120.0 / probability.shape[1]
    return find_patch(probability, segmenter.threshold, MIN_AREA_PX, frame_px)


def _table(found: Sequence[Sample]) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Errors, the (n, 3) parts of sigma before their constants, and weights that add up to 1."""
    error = np.array([one.error_deg for one in found])
    parts = np.array(
        [
            [faintness(a) * a.spread_deg, faintness(a) * grown_deg(a), faintness(a) * a.unlike * a.misfit_deg]
            for a in (one.answer for one in found)
        ]
    )
    _, place, count = np.unique([one.grasp for one in found], return_inverse=True, return_counts=True)
    weight = 1.0 / count[place]
    return error, parts, weight / weight.sum()


def _surprise(
    logs: NDArray[np.float64], error: NDArray[np.float64], parts: NDArray[np.float64], weight: NDArray[np.float64]
) -> float:
    """Negative log likelihood of Student's t, per error."""
    square = (parts**2) @ np.exp(2.0 * logs) + texture.SIGMA_FLOOR_DEG**2
    half = (DEGREES_OF_FREEDOM + 1.0) / 2.0
    return float(weight @ (0.5 * np.log(square) + half * np.log1p(error**2 / square / DEGREES_OF_FREEDOM)))


def main(arguments: Sequence[str] | None = None) -> None:
    """The command."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grasps", type=int, default=2, help="grasps of each training object")
    parser.add_argument("--model", type=Path, default=None, help="segmentation network; the shipped one if left out")
    chosen = parser.parse_args(arguments)
    grasps = (sequences.sequence(name, SEED + number) for number in range(chosen.grasps) for name in names("train"))
    found = list(samples(grasps, Segmenter(chosen.model)))
    worst = max(found, key=lambda one: abs(one.error_deg) / sigma_deg(one.answer))
    print(f"{len(found)} turns of {len({one.grasp for one in found})} grasps, training objects, seeds from {SEED}")
    in_use = (texture.SPREAD_SIGMA, texture.GROWTH_SIGMA, texture.MISFIT_SIGMA)
    for word, (spread, growth, misfit) in (("in use", in_use), ("fitted", fitted(found))):
        print(f"{word}: SPREAD {spread:.3g}, GROWTH {growth:.3g}, MISFIT {misfit:.3g}")
    held = [within(found, sigmas) for sigmas in (1.0, 2.0, 5.0)]
    print(f"in use, within 1 sigma {held[0]:.3f}, 2 sigma {held[1]:.3f}, 5 sigma {held[2]:.4f}")
    print(f"worst: {worst.grasp}, {worst.error_deg:+.2f} degrees at sigma {sigma_deg(worst.answer):.2f}")
    print(f"root mean square error {math.sqrt(sum(one.error_deg**2 for one in found) / len(found)):.3f} degrees")


if __name__ == "__main__":
    main()
