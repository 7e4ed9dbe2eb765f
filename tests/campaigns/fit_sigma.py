"""A fit of the constants of the rotation's sigma, and of its correction, to rendered grasps of the training objects.

The registration's errors are not Gaussian, and the effects differ: the constants minimize the negative log likelihood
of Student's t, in which every effect has the same weight. Sigma is computed by the product itself with each candidate.
"""

from __future__ import annotations

import contextlib
import copy
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipguard.datasets.effect_scenes import EFFECTS, render_effect
from slipguard.datasets.rendered_grasps import FRAME_S, RenderedGrasp, render_grasp
from slipguard.devices import FRAME_WIDTH_PX
from slipguard.perception import gel_memory, registration
from slipguard.perception.estimate import RotationEstimate
from slipguard.perception.gel_memory import ImprintMemory
from slipguard.perception.patch import Patch, find_patch
from slipguard.perception.registration import Registration
from slipguard.perception.rotation_filter import RotationFilter
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.texture_map import TextureMapReader
from slipguard.perception.texture_template import make_texture_template
from slipguard.perception.texture_tracker import TextureTracker
from slipguard.sim.catalogue import find_object, object_names

SEED = 8300
ORDINARY = "ordinary"
MODULES = {"registration": registration, "gel_memory": gel_memory}
FITTED = (
    ("registration", "SPREAD"),
    ("registration", "DEFORMED"),
    ("registration", "LEAD"),
    ("registration", "ROLLING"),
    ("registration", "LEAD_CORRECTION"),
    ("gel_memory", "SPREAD_SHARE"),
    ("gel_memory", "CORRECTION_SHARE"),
)
"""The fitted constants by module. All are positive."""
Constants = Mapping[tuple[str, str], float]
DEGREES_OF_FREEDOM = 8.0
"""Errors have heavier tails than a Gaussian: a single bad grasp must not determine the constants."""
STEPS = (0.4, 0.2, 0.1, 0.05, 0.02)
"""Relative steps of the search, which tries each constant in turn."""
IMPROVED = 1e-5
"""A smaller improvement of the likelihood per error ends the search with a step."""


@dataclass(frozen=True, slots=True, eq=False)
class RotationSample:
    """One frame of known rotation. best: its registration, None if declined. memory: of the gel, after this frame."""

    effect: str
    rotation_deg: float
    best: Registration | None
    memory: ImprintMemory

    def measured(self) -> RotationEstimate:
        """Return the rotation and its sigma with the constants in use."""
        if self.best is None:
            return RotationEstimate(None, None)
        return copy.copy(self.memory).corrected(self.best.rotation_deg, self.best.sigma_deg, self.best.ghost)


def training_grasps(count: int) -> Iterator[tuple[str, RenderedGrasp]]:
    """Yield each effect with grasps of the training objects that have an axis, `count` of each."""
    for name in object_names("train"):
        if find_object(name).axial:
            for seed in range(SEED, SEED + count):
                yield ORDINARY, render_grasp(name, seed)
                for effect in EFFECTS:
                    yield effect, render_effect(effect, name, seed)


def samples(effect: str, grasp: RenderedGrasp, segmenter: Segmenter) -> Iterator[RotationSample]:
    """Follow the texture of a grasp since its last frame at rest, frame by frame; a round one gives nothing."""
    start = next(k for k, shot in enumerate(grasp.shots) if shot.compared) - 1
    reader = TextureMapReader(grasp.background, np.array(grasp.noise_bgr))
    patch, image = _patch(segmenter, grasp, start), grasp.shots[start].frame.image
    if patch is None:
        return
    reader.learn(image, patch)
    template = make_texture_template(reader.read(image, patch), patch)
    if template is None or template.round_reason is not None:
        return
    rotations = RotationFilter()
    rotations.start(start * FRAME_S)
    tracker = TextureTracker(template, rotations)
    for k, shot in enumerate(grasp.shots):
        patch = _patch(segmenter, grasp, k) if shot.compared else None
        if patch is None:
            continue
        found = tracker.track(reader.read(shot.frame.image, patch), patch.center_px, k * FRAME_S)
        best = None if found.rotation.rotation_deg is None else found.best
        yield RotationSample(effect, shot.rotation_deg, best, copy.copy(tracker._memory))


def _patch(segmenter: Segmenter, grasp: RenderedGrasp, index: int) -> Patch | None:
    probability = segmenter.segment(grasp.shots[index].frame.image, grasp.background)
    settings = PerceptionSettings()
    return find_patch(probability, segmenter.threshold, settings.min_area_px, FRAME_WIDTH_PX / probability.shape[1])


def constants_in_use() -> dict[tuple[str, str], float]:
    return {(module, name): float(getattr(MODULES[module], name)) for module, name in FITTED}


@contextlib.contextmanager
def using(constants: Constants) -> Iterator[None]:
    """Let the product compute with these constants."""
    before = constants_in_use()
    try:
        for (module, name), value in constants.items():
            setattr(MODULES[module], name, value)
        yield
    finally:
        for (module, name), value in before.items():
            setattr(MODULES[module], name, value)


def negative_log_likelihood(found: Iterable[RotationSample], constants: Constants) -> float:
    """Return the mean negative log likelihood of the errors, Student's t; each effect has the same weight."""
    costs: dict[str, list[float]] = {}
    nu = DEGREES_OF_FREEDOM
    with using(constants):
        for one in found:
            measured = one.measured()
            if measured.rotation_deg is None or measured.sigma_deg is None:
                continue
            sigmas = (measured.rotation_deg - one.rotation_deg) / measured.sigma_deg
            cost = math.log(measured.sigma_deg) + 0.5 * (nu + 1.0) * math.log1p(sigmas * sigmas / nu)
            costs.setdefault(one.effect, []).append(cost)
    return float(np.mean([np.mean(one) for one in costs.values()]))


def fitted(found: Sequence[RotationSample]) -> dict[tuple[str, str], float]:
    """Return the constants of the largest likelihood, searched from those in use."""
    best = constants_in_use()
    cost = negative_log_likelihood(found, best)
    for step in STEPS:
        improved = True
        while improved:
            improved = False
            for constant in FITTED:
                for factor in (1.0 + step, 1.0 / (1.0 + step)):
                    other = {**best, constant: best[constant] * factor}
                    now = negative_log_likelihood(found, other)
                    if now < cost - IMPROVED:
                        best, cost, improved = other, now, True
    return best


def table(found: Sequence[RotationSample], constants: Constants) -> list[str]:
    """Return one line for each effect: error, declined frames, shares within and beyond sigma, and sigma's size."""
    limit_deg = PerceptionSettings().sigma_max_deg
    lines = []
    with using(constants):
        for effect in dict.fromkeys(one.effect for one in found):
            some = [(one.rotation_deg, one.measured()) for one in found if one.effect == effect]
            kept = [
                (abs(measured.rotation_deg - truth_deg), measured.sigma_deg)
                for truth_deg, measured in some
                if measured.rotation_deg is not None
                and measured.sigma_deg is not None
                and measured.sigma_deg <= limit_deg
            ]
            if not kept:
                lines.append(f"{effect:12s} n {len(some):5d}, all declined")
                continue
            error, sigma = np.array(kept).T
            sigmas = error / sigma
            lines.append(
                f"{effect:12s} n {len(some):5d} mean {error.mean():.3f} declined {1.0 - len(kept) / len(some):5.1%} "
                f"within 1 {np.mean(sigmas <= 1.0):4.0%} 2 {np.mean(sigmas <= 2.0):4.0%} "
                f"beyond 3 {np.mean(sigmas > 3.0):5.1%} 4 {np.mean(sigmas > 4.0):5.1%} "
                f"median sigma / error {np.median(sigma) / max(float(np.median(error)), 1e-9):.1f}"
            )
    return lines


def fit_and_report(grasps: int, model: Path | None) -> None:
    """Measure rotations of known size, fit the constants, and print both sets with what they give by effect."""
    segmenter = Segmenter(model)
    found = [one for effect, grasp in training_grasps(grasps) for one in samples(effect, grasp, segmenter)]
    print(f"{len(found)} frames of the training objects, seeds {SEED} to {SEED + grasps - 1}")
    for title, constants in (("in use", constants_in_use()), ("fitted", fitted(found))):
        named = ", ".join(f"{name} {value:.3g}" for (_, name), value in constants.items())
        print(f"{title}: {named}; negative log likelihood {negative_log_likelihood(found, constants):.4f}")
        print(*table(found, constants), sep="\n")
