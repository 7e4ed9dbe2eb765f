"""An experiment in figures: per object, per estimator and per network, with confidence intervals."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from slipguard.bench.results import PUBLISHED
from slipguard.evaluation.lift_analysis import LiftResult
from slipguard.tools.sample_statistics import mean, rounded

PAPER = {name: PUBLISHED[name] for name in ("turn_error_mean_deg", "turn_error_sd_deg", "turn_error_worst_object_deg")}
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
        values = {name: rounded(getattr(self, name)) for name in ("mean", "sd", "worst", "low", "high")}
        return {"n": self.n, **values}


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


def lift_statistics(values: Sequence[float]) -> LiftStatistics:
    """Return the statistics of some values; the interval is a bootstrap."""
    if not values:
        return LiftStatistics(0)
    data = np.asarray(values, np.float64)
    rng = np.random.default_rng(0)
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


def report_json(lifts: list[LiftResult]) -> dict[str, Any]:
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
        "turn_error_mean_deg": rounded(fused.mean),
        "turn_error_sd_deg": rounded(fused.sd),
        "turn_error_worst_object_deg": rounded(worst),
        "turn_error_worst_lift_deg": rounded(fused.worst),
        "turn_error_with_the_lag_left_in_deg": rounded(mean(unaligned)),
        "declined_share": rounded(mean([lift.declined_share for lift in lifts])),
        "within_1_sigma": rounded(mean([pair[0] for pair in known if pair[0] is not None])),
        "within_2_sigma": rounded(mean([pair[1] for pair in known if pair[1] is not None])),
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
                "declined_share": rounded(one.declined_share),
                "turns_deg": [round(rotation, 2) for rotation in one.rotations_deg],
                **{name: one.errors[name].as_json() for name in ESTIMATORS},
            }
            for one in objects
        },
        "lag_error_frames": rounded(max(lags)) if lags else None,
        "lag_ms": {lift.stem: round(1e3 * lift.lag_s, 1) for lift in lifts if lift.lag_unknown is None},
        "lag_unknown": {lift.stem: lift.lag_unknown for lift in lifts if lift.lag_unknown is not None},
        "aruco_error_mean_deg": rounded(mean(markers)),
        "aruco_error_worst_deg": rounded(
            max((lift.marker_error_worst_deg or 0.0 for lift in lifts), default=0.0) if markers else None
        ),
        "camera_gaps": sum(lift.camera_gaps for lift in lifts),
        "dice": lift_statistics(dices).as_json() if dices else None,
        "iou": lift_statistics(ious).as_json() if ious else None,
        "networks": None,  # `python -m tests.campaigns network-table --lifts` compares networks
        "problems": {lift.stem: lift.problem for lift in lifts if lift.problem is not None},
        "paper_real_cell_as_published": PAPER | {"dice": PAPER_DICE[0], "iou": PAPER_IOU[0]},
    }
