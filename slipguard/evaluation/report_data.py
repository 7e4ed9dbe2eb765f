"""An experiment in figures: per object, per estimator and per network, with confidence intervals."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError, ModelError
from slipguard.evaluation.lift_analysis import MASK_GAP_S, LiftResult, mask_of
from slipguard.evaluation.lift_recording import LiftData, LiftFrame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.tools.replay import recorded_settings

PAPER = {"turn_error_mean_deg": 1.854, "turn_error_sd_deg": 0.988, "turn_error_worst_object_deg": 3.0}
PAPER_DICE, PAPER_IOU = (0.956, 0.013), (0.914, 0.023)
"""Castano-Amoros & Gil, 45 lifts of 9 objects on a real cell, as published."""
ESTIMATORS = ("fused", "skeleton", "pca", "ellipse", "moments")
RESAMPLES = 2000


@dataclass(frozen=True, slots=True)
class LiftStatistics:
    """Mean, standard deviation, maximum and 95 % bootstrap interval of the mean, over lifts. None if n is 0."""

    n: int
    mean: float | None = None
    sd: float | None = None
    worst: float | None = None
    low: float | None = None
    high: float | None = None

    def as_json(self) -> dict[str, Any]:
        """Return the JSON form, rounded to four digits."""
        rounded = {name: _rounded(getattr(self, name)) for name in ("mean", "sd", "worst", "low", "high")}
        return {"n": self.n, **rounded}


@dataclass(frozen=True, slots=True)
class ObjectFigures:
    """Figures of one object. errors: by estimator, over its comparable lifts."""

    name: str
    seen: bool
    hard: str
    lifts: int
    errors: dict[str, LiftStatistics]
    declined_share: float
    rotations_deg: tuple[float, ...]


def lift_statistics(values: Sequence[float], seed: int = 0) -> LiftStatistics:
    """Return the statistics of some values; the interval is a bootstrap."""
    if not values:
        return LiftStatistics(0)
    data = np.asarray(values, np.float64)
    rng = np.random.default_rng(seed)
    means = rng.choice(data, (RESAMPLES, len(data))).mean(1)
    low, high = np.percentile(means, (2.5, 97.5))
    sd = float(data.std(ddof=1)) if len(data) > 1 else 0.0
    return LiftStatistics(len(data), float(data.mean()), sd, float(data.max()), float(low), float(high))


def errors_of(lifts: list[LiftResult], estimator: str) -> list[float]:
    means = [lift.errors[estimator].mean_deg for lift in lifts if estimator in lift.errors]
    return [mean for mean in means if mean is not None]


def by_object(lifts: list[LiftResult]) -> list[ObjectFigures]:
    """Return the figures of each object, in the order of the protocol."""
    figures = []
    for name in dict.fromkeys(lift.object for lift in lifts):
        own = [lift for lift in lifts if lift.object == name]
        rotations = tuple(lift.final_rotation_deg for lift in own if lift.final_rotation_deg is not None)
        figures.append(
            ObjectFigures(
                name,
                own[0].seen,
                own[0].hard,
                len(own),
                {estimator: lift_statistics(errors_of(own, estimator)) for estimator in ESTIMATORS},
                float(np.mean([lift.declined_share for lift in own])),
                rotations,
            )
        )
    return figures


def report_json(lifts: list[LiftResult], networks: list[dict[str, Any]] | None = None) -> dict[str, Any]:
    """Return the content of `report.json`; numbers are rounded, null if not available."""
    objects = by_object(lifts)
    fused = lift_statistics(errors_of(lifts, "fused"))
    worst = max((one.errors["fused"].mean for one in objects if one.errors["fused"].mean is not None), default=None)
    lags = [lift.lag_error_frames for lift in lifts if lift.lag_error_frames is not None]
    markers = [lift.marker_error_mean_deg for lift in lifts if lift.marker_error_mean_deg is not None]
    dices = [value for lift in lifts for value in lift.dice]
    ious = [value for lift in lifts for value in lift.iou]
    sigma = [(lift.within_1_sigma, lift.within_2_sigma) for lift in lifts]
    known = [pair for pair in sigma if pair[0] is not None and pair[1] is not None]
    unaligned = [lift.unaligned_mean_deg for lift in lifts if lift.unaligned_mean_deg is not None]
    return {
        "lifts": len(lifts),
        "simulated": all(lift.simulated for lift in lifts),
        "lifts_compared": fused.n,
        "turn_error_mean_deg": _rounded(fused.mean),
        "turn_error_sd_deg": _rounded(fused.sd),
        "turn_error_worst_object_deg": _rounded(worst),
        "turn_error_worst_lift_deg": _rounded(fused.worst),
        "turn_error_with_the_lag_left_in_deg": _mean(unaligned),
        "declined_share": _mean([lift.declined_share for lift in lifts]),
        "within_1_sigma": _mean([pair[0] for pair in known if pair[0] is not None]),
        "within_2_sigma": _mean([pair[1] for pair in known if pair[1] is not None]),
        "per_estimator": {name: lift_statistics(errors_of(lifts, name)).as_json() for name in ESTIMATORS},
        "seen": lift_statistics(errors_of([lift for lift in lifts if lift.seen], "fused")).as_json(),
        "unseen": lift_statistics(errors_of([lift for lift in lifts if not lift.seen], "fused")).as_json(),
        "hard": lift_statistics(errors_of([lift for lift in lifts if lift.hard], "fused")).as_json(),
        "without_hard": lift_statistics(errors_of([lift for lift in lifts if not lift.hard], "fused")).as_json(),
        "per_object": {
            one.name: {
                "lifts": one.lifts,
                "seen": one.seen,
                "hard": one.hard or None,
                "declined_share": _rounded(one.declined_share),
                "turns_deg": [round(rotation, 2) for rotation in one.rotations_deg],
                **{name: one.errors[name].as_json() for name in ESTIMATORS},
            }
            for one in objects
        },
        "lag_error_frames": _rounded(max(lags)) if lags else None,
        "lag_ms": {lift.stem: round(1e3 * lift.lag_s, 1) for lift in lifts if lift.lag_unknown is None},
        "lag_unknown": {lift.stem: lift.lag_unknown for lift in lifts if lift.lag_unknown is not None},
        "aruco_error_mean_deg": _mean(markers),
        "aruco_error_worst_deg": _rounded(
            max((lift.marker_error_worst_deg or 0.0 for lift in lifts), default=0.0) if markers else None
        ),
        "camera_gaps": sum(lift.camera_gaps for lift in lifts),
        "dice": lift_statistics(dices).as_json() if dices else None,
        "iou": lift_statistics(ious).as_json() if ious else None,
        "networks": networks,
        "problems": {lift.stem: lift.problem for lift in lifts if lift.problem is not None},
        "paper_real_cell_as_published": PAPER | {"dice": PAPER_DICE[0], "iou": PAPER_IOU[0]},
    }


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(float(value), 4)


def _mean(values: Sequence[float]) -> float | None:
    return _rounded(float(np.mean(values))) if values else None


EVERY = 10


class SegmentationScore:
    """Accumulates the scores of one network over lifts."""

    def __init__(self, path: Path | None) -> None:
        self.name = "shipped" if path is None else path.stem
        self._segmenter = Segmenter(path)
        self._dice: list[float] = []
        self._iou: list[float] = []
        self._ms: list[float] = []

    def add(self, data: LiftData) -> None:
        """Segment the frames of a lift that have a true mask; without true masks, time every tenth frame."""
        settings = recorded_settings(data.recording)
        for finger, frames in data.fingers.items():
            with_image = [one for one in frames if one.image is not None]
            if not with_image:
                continue
            background = settings.background(finger)
            masks = data.true_masks[finger]
            if not masks:
                for one in with_image[::EVERY]:
                    self._segment(one, background)
                continue
            times = np.array([one.record.captured_at_s for one in with_image])
            for true in masks:
                near = int(np.argmin(np.abs(times - true.time_s)))
                if abs(times[near] - true.time_s) <= MASK_GAP_S:
                    found = self._segment(with_image[near], background)
                    self._dice.append(dice(found, mask_of(true)))
                    self._iou.append(iou(found, mask_of(true)))

    def _segment(self, one: LiftFrame, background: NDArray[np.uint8] | None) -> NDArray[np.bool_]:
        """Return the mask at frame size and record the time it took."""
        assert one.image is not None
        image = one.image.pixels()
        began_s = time.perf_counter()
        probability = self._segmenter.segment(image, background)
        self._ms.append(1e3 * (time.perf_counter() - began_s))
        return np.asarray(cv2.resize(probability, (image.shape[1], image.shape[0])) > self._segmenter.threshold)

    def as_json(self) -> dict[str, Any]:
        return {
            "network": self.name,
            "n": len(self._ms),
            "dice": lift_statistics(self._dice).as_json(),
            "iou": lift_statistics(self._iou).as_json(),
            "ms_median": round(float(np.median(self._ms)), 2) if self._ms else None,
        }


def segmentation_scores(folder: Path) -> list[SegmentationScore]:
    """Return the shipped network and every usable one of a folder. Raises InputError if there is none."""
    files = sorted(folder.glob("*.onnx")) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: no .onnx networks in this folder")
    rows = [SegmentationScore(None)]
    refused = []
    for file in files:
        try:
            rows.append(SegmentationScore(file))
        except ModelError as error:
            refused.append(str(error))
    if len(rows) == 1:
        raise InputError(f"{folder}: no usable network: {refused[0]}")
    return rows
