"""What undetected tears cost: rotation errors of the pipeline on rendered grasps of which some frames are torn."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from slipguard.datasets.rendered_grasps import RenderedGrasp, render_grasp
from slipguard.devices import Frame
from slipguard.errors import FrameTorn
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from tests.campaigns.torn.splices import spliced


@dataclass(slots=True)
class AngleErrors:
    """Rotation errors in degrees: of good frames, and of torn ones that were not detected.

    A torn frame shows the object at two times; its error is the distance from the nearer rotation.
    """

    torn: int = 0
    refused: int = 0
    false: int = 0
    """Good frames that were refused."""
    good_deg: list[float] = field(default_factory=list)
    undetected_deg: list[float] = field(default_factory=list)
    undetected_sigmas: list[float] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """Return the figures."""
        return {
            "torn": self.torn,
            "refused": self.refused,
            "false": self.false,
            "good_mean_deg": _mean(self.good_deg),
            "undetected": len(self.undetected_deg),
            "undetected_mean_deg": _mean(self.undetected_deg),
            "undetected_max_deg": round(max(self.undetected_deg, default=0.0), 2),
            "undetected_beyond_4_sigma": sum(one > 4.0 for one in self.undetected_sigmas),
        }


def angle_errors(names: tuple[str, ...], share: float, seeds: int = 1) -> AngleErrors:
    """Run the pipeline on grasps; `share` of the frames are torn at a random column."""
    errors, segmenter = AngleErrors(), Segmenter()
    for seed in range(seeds):
        for name in names:
            _one_grasp(render_grasp(name, seed), share, segmenter, np.random.default_rng([seed, len(name)]), errors)
    return errors


def _one_grasp(
    grasp: RenderedGrasp, share: float, segmenter: Segmenter, rng: np.random.Generator, errors: AngleErrors
) -> None:
    pipeline = Pipeline(segmenter, PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
    before = grasp.shots[0]
    for shot in grasp.shots:
        torn = shot is not before and rng.random() < share
        frame = shot.frame
        if torn:
            column = int(rng.integers(1, frame.image.shape[1]))
            frame = replace_image(frame, before.frame, column)
        errors.torn += torn
        try:
            estimate = pipeline.process(frame)
        except FrameTorn:
            errors.refused += torn
            errors.false += not torn
        else:
            if shot.compared and estimate.rotation_deg is not None and estimate.sigma_deg is not None:
                error = abs(estimate.rotation_deg - shot.rotation_deg)
                if torn:
                    error = min(error, abs(estimate.rotation_deg - before.rotation_deg))
                    errors.undetected_deg.append(error)
                    errors.undetected_sigmas.append(error / estimate.sigma_deg)
                else:
                    errors.good_deg.append(error)
        before = shot


def replace_image(frame: Frame, before: Frame, column: int) -> Frame:
    """Return the frame with its columns before `column` from the frame before."""
    return replace(frame, image=spliced(before.image, frame.image, "column", column))


def _mean(values: list[float]) -> float | None:
    return round(float(np.mean(values)), 3) if values else None
