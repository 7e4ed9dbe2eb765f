"""How well the pipeline tells turns of known size on real pixels: grasp by grasp, relit and rigid."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from slipguard.errors import InputError
from slipguard.evaluation.rotated_presses import PressImage, RotationMethod, press_images, rotated_grasp
from slipguard.perception.pipeline import ContactSegmenter, Pipeline
from slipguard.perception.settings import PerceptionSettings

SEED = 1
CONFIDENT_SIGMAS = 3.0


@dataclass(frozen=True, slots=True)
class PressResult:
    """One turned press. errors_deg: (error, sigma) of every frame with an angle; frames: compared in all.

    confident: answers of a turn of more than three sigmas where there is none to tell (a ball).
    """

    name: str
    readable: bool
    errors_deg: tuple[tuple[float, float], ...]
    frames: int
    confident: int

    @property
    def mean_deg(self) -> float | None:
        """Mean error without sign; None where nothing was told."""
        return float(np.mean([abs(error) for error, _ in self.errors_deg])) if self.errors_deg else None


@dataclass(frozen=True, slots=True)
class PressStatistics:
    """What comes of one data set. Degrees; None where nothing was told."""

    data: str
    way: RotationMethod
    sequences: int
    frames: int
    mean_deg: float | None
    worst_sequence_deg: float | None
    p95_deg: float | None
    within_1_sigma: float | None
    within_2_sigma: float | None
    declined_share: float
    confident_round_rotations: int


def measure(
    folder: Path,
    part: str,
    way: RotationMethod,
    segmenter: ContactSegmenter,
    progress: Callable[[str, float], None] = lambda _what, _share: None,
) -> list[PressResult]:
    """Turn every press of one part ("tune", "test" or "all") and measure it as the daemon would.

    Raises `InputError` for another part, and where the folder holds no press of it.
    """
    if part not in ("tune", "test", "all"):
        raise InputError(f"part {part!r}: there are tune, test, all")
    chosen = [press for press in press_images(folder) if part in (press.part, "all")]
    if not chosen:
        raise InputError(f"{folder}: no press of the part {part!r} lies wholly in its frame")
    out = []
    for index, press in enumerate(chosen):
        progress(press.name, index / len(chosen))
        out.append(_told(press, way, segmenter))
    return out


def press_statistics(found: Iterable[PressResult], way: RotationMethod) -> list[PressStatistics]:
    """One row a data set."""
    sets: dict[str, list[PressResult]] = {}
    for one in found:
        sets.setdefault(one.name.split("/")[0], []).append(one)
    return [_figures(name, way, told) for name, told in sets.items()]


def _told(press: PressImage, way: RotationMethod, segmenter: ContactSegmenter) -> PressResult:
    grasp = rotated_grasp(press, way, SEED)
    pipeline = Pipeline(segmenter, PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
    errors, frames, confident = [], 0, 0
    for shot in grasp.shots:
        seen = pipeline.process(shot.frame)
        if not shot.compared:
            continue
        frames += 1
        if seen.angle_deg is not None and seen.sigma_deg is not None:
            errors.append((seen.angle_deg - shot.rotation_deg, seen.sigma_deg))
            confident += not press.readable and abs(seen.angle_deg) > CONFIDENT_SIGMAS * seen.sigma_deg
    return PressResult(press.name, press.readable, tuple(errors), frames, confident)


def _figures(data: str, way: RotationMethod, told: list[PressResult]) -> PressStatistics:
    pairs = np.array([pair for one in told for pair in one.errors_deg], np.float64).reshape(-1, 2)
    errors, sigmas = np.abs(pairs[:, 0]), pairs[:, 1]
    frames = sum(one.frames for one in told)
    means = [one.mean_deg for one in told if one.mean_deg is not None]
    some = len(errors) > 0
    return PressStatistics(
        data=data,
        way=way,
        sequences=len(told),
        frames=frames,
        mean_deg=_rounded(errors.mean()) if some else None,
        worst_sequence_deg=_rounded(max(means)) if means else None,
        p95_deg=_rounded(np.quantile(errors, 0.95)) if some else None,
        within_1_sigma=_rounded(np.mean(errors <= sigmas)) if some else None,
        within_2_sigma=_rounded(np.mean(errors <= 2.0 * sigmas)) if some else None,
        declined_share=_rounded(1.0 - len(errors) / max(frames, 1)),
        confident_round_rotations=sum(one.confident for one in told),
    )


def _rounded(value: Any) -> float:
    return round(float(value), 4)
