"""How the shipped pipeline errs, object by object: the grasps of `slipguard bench`, measured again frame by frame.

`python -m slipguard.bench.grip.fit` prints the table that `errors.py` holds.
"""

from __future__ import annotations

import numpy as np

from slipguard.bench.grip.modeled_perception import SightError
from slipguard.bench.grip.rendered_perception import segmenter
from slipguard.bench.grip.trials import TEST_OBJECTS
from slipguard.bench.run import FULL_GRASPS, SEED
from slipguard.datasets.rendered_grasps import render_grasp
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings

SMALL_DEG, LARGE_DEG = 3.0, 5.0
"""An error within the first turn of so much comes with the motion; beyond the second it grows with the turn."""

SHORTEST = 10
"""A grasp with fewer answers tells nothing."""
MEDIAN_OF_A_DIFFERENCE = 0.954
"""Of two normal values, over one standard deviation."""


def fitted(object_name: str, grasps: int = FULL_GRASPS) -> SightError:
    """The errors of one object, over so many of the bench's grasps."""
    slopes, offsets, noises, sigmas = [], [], [], []
    asked = declined = 0
    for k in range(grasps):
        grasp = render_grasp(object_name, SEED + k)
        pipeline = Pipeline(segmenter(), PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
        found = [(shot, pipeline.process(shot.frame)) for shot in grasp.shots]
        compared = [(shot, estimate) for shot, estimate in found if shot.compared]
        told = [
            (shot.rotation_deg, estimate.angle_deg - shot.rotation_deg, estimate.sigma_deg or 0.0)
            for shot, estimate in compared
            if estimate.angle_deg is not None
        ]
        asked, declined = asked + len(compared), declined + len(compared) - len(told)
        if len(told) < SHORTEST:
            continue
        rotation, error, sigma = np.asarray(told).T
        noises.append(float(np.median(np.abs(np.diff(error)))) / MEDIAN_OF_A_DIFFERENCE)
        near, far = np.abs(rotation) < SMALL_DEG, np.abs(rotation) > LARGE_DEG
        if near.any():  # where a slip is noticed; a long turn's sigma comes too late to matter
            sigmas.append(float(np.median(sigma[near])))
            offsets.append(float(np.mean(error[near])))
        if far.any():
            slopes.append(float(np.median(error[far] / rotation[far])))
    return SightError(
        noise_deg=_rms(noises),
        bias_per_deg=_rms(slopes),
        bias_deg=_rms(offsets),
        sigma_deg=float(np.median(sigmas)) if sigmas else SightError().sigma_deg,
        declined=declined / max(asked, 1),
    )


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else 0.0


def table() -> str:
    """The figures of every test object, as Python."""
    lines = []
    for name in TEST_OBJECTS:
        error = fitted(name)
        lines.append(
            f'    "{name}": SightError({error.noise_deg:.3f}, {error.bias_per_deg:.4f}, {error.bias_deg:.3f}, '
            f"{error.sigma_deg:.3f}, {error.declined:.4f}),"
        )
    return "\n".join(lines)


if __name__ == "__main__":
    print(table())
