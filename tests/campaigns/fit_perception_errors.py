"""A fit of the error model of `slipguard bench --grip` to the errors of the shipped pipeline, object by object."""

from __future__ import annotations

import numpy as np

from slipguard.bench.grip.perception_models import PerceptionErrors, segmenter
from slipguard.bench.grip.trials import TEST_OBJECTS
from slipguard.bench.run import FULL_GRASPS, SEED
from slipguard.datasets.rendered_grasps import render_grasp
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings

SMALL_DEG, LARGE_DEG = 3.0, 5.0
"""The offset is measured below the first rotation, the error proportional to the rotation beyond the second."""

MIN_ESTIMATES = 10
"""Grasps with fewer estimates are not used."""
MEDIAN_OF_A_DIFFERENCE = 0.954
"""Median absolute difference of two normal values, in standard deviations."""


def fit_errors(object_name: str, grasps: int = FULL_GRASPS) -> PerceptionErrors:
    """Return the error model of one object, fitted to grasps of the bench."""
    slopes, offsets, noises, sigmas = [], [], [], []
    compared_frames = declined = 0
    for k in range(grasps):
        grasp = render_grasp(object_name, SEED + k)
        pipeline = Pipeline(segmenter(), PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
        found = [(shot, pipeline.process(shot.frame)) for shot in grasp.shots]
        compared = [(shot, estimate) for shot, estimate in found if shot.compared]
        estimated = [
            (shot.rotation_deg, estimate.rotation_deg - shot.rotation_deg, estimate.sigma_deg or 0.0)
            for shot, estimate in compared
            if estimate.rotation_deg is not None
        ]
        compared_frames, declined = compared_frames + len(compared), declined + len(compared) - len(estimated)
        if len(estimated) < MIN_ESTIMATES:
            continue
        rotation, error, sigma = np.asarray(estimated).T
        noises.append(float(np.median(np.abs(np.diff(error)))) / MEDIAN_OF_A_DIFFERENCE)
        near, far = np.abs(rotation) < SMALL_DEG, np.abs(rotation) > LARGE_DEG
        if near.any():  # the sigma of small rotations decides when slip is detected
            sigmas.append(float(np.median(sigma[near])))
            offsets.append(float(np.mean(error[near])))
        if far.any():
            slopes.append(float(np.median(error[far] / rotation[far])))
    return PerceptionErrors(
        noise_deg=_rms(noises),
        bias_per_deg=_rms(slopes),
        bias_deg=_rms(offsets),
        sigma_deg=float(np.median(sigmas)) if sigmas else PerceptionErrors().sigma_deg,
        declined=declined / max(compared_frames, 1),
    )


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else 0.0


def error_table(grasps: int) -> str:
    """Return the error model of every test object, as Python."""
    lines = []
    for name in TEST_OBJECTS:
        error = fit_errors(name, grasps)
        lines.append(
            f'    "{name}": PerceptionErrors({error.noise_deg:.3f}, {error.bias_per_deg:.4f}, {error.bias_deg:.3f}, '
            f"{error.sigma_deg:.3f}, {error.declined:.4f}),"
        )
    return "\n".join(lines)
