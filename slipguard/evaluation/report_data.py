"""An experiment in figures, per object and in all, with confidence intervals."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from slipguard.bench.results import PUBLISHED
from slipguard.evaluation.lift_analysis import LiftResult
from slipguard.tools.figures import Figures, rounded

PAPER = {name: PUBLISHED[name] for name in ("turn_error_mean_deg", "turn_error_sd_deg", "turn_error_worst_object_deg")}
PAPER_DICE, PAPER_IOU = (0.956, 0.013), (0.914, 0.023)
"""Castano-Amoros & Gil, 45 lifts of 9 objects on a real cell, as published."""
RESAMPLES = 2000


def statistics(values: Sequence[float]) -> dict[str, Any]:
    """Return count, mean, sd, maximum and the 95 % bootstrap interval of the mean, rounded; None without values."""
    figures = Figures.of(values)
    low = high = None
    if values:
        means = np.random.default_rng(0).choice(values, (RESAMPLES, len(values))).mean(1)
        low, high = (float(end) for end in np.percentile(means, (2.5, 97.5)))
    known = {"mean": figures.mean, "sd": figures.sd, "worst": figures.worst, "low": low, "high": high}
    return {"n": figures.count, **{name: rounded(value) for name, value in known.items()}}


def errors_of(lifts: Iterable[LiftResult]) -> list[float]:
    """Return the mean error of each lift that could be compared, in degrees."""
    means = [lift.errors["fused"].mean_deg for lift in lifts if "fused" in lift.errors]
    return [mean for mean in means if mean is not None]


def by_object(lifts: Iterable[LiftResult]) -> dict[str, list[LiftResult]]:
    """Return the lifts of each object, in the order of the protocol."""
    found: dict[str, list[LiftResult]] = {}
    for lift in lifts:
        found.setdefault(lift.object, []).append(lift)
    return found


def report_json(lifts: Sequence[LiftResult]) -> dict[str, Any]:
    """Return the content of `report.json`; numbers are rounded, null if not available."""
    fused = statistics(errors_of(lifts))
    objects = {name: _object_json(own) for name, own in by_object(lifts).items()}
    means = [one["fused"]["mean"] for one in objects.values() if one["fused"]["mean"] is not None]
    dices = [value for lift in lifts for value in lift.dice]
    ious = [value for lift in lifts for value in lift.iou]

    def known(value_of: Callable[[LiftResult], float | None]) -> Figures:
        values = [value_of(lift) for lift in lifts]
        return Figures.of(value for value in values if value is not None)

    def errors_where(chosen: Callable[[LiftResult], bool]) -> dict[str, Any]:
        return statistics(errors_of(lift for lift in lifts if chosen(lift)))

    return {
        "lifts": len(lifts),
        "simulated": all(lift.simulated for lift in lifts),
        "lifts_compared": fused["n"],
        "turn_error_mean_deg": fused["mean"],
        "turn_error_sd_deg": fused["sd"],
        "turn_error_worst_object_deg": max(means, default=None),
        "turn_error_worst_lift_deg": fused["worst"],
        "turn_error_with_the_lag_left_in_deg": rounded(known(lambda lift: lift.unaligned_mean_deg).mean),
        "declined_share": rounded(known(lambda lift: lift.declined_share).mean),
        "within_1_sigma": rounded(known(lambda lift: lift.within_1_sigma).mean),
        "within_2_sigma": rounded(known(lambda lift: lift.within_2_sigma).mean),
        "per_estimator": {"fused": fused},
        "seen": errors_where(lambda lift: lift.seen),
        "unseen": errors_where(lambda lift: not lift.seen),
        "hard": errors_where(lambda lift: bool(lift.hard)),
        "without_hard": errors_where(lambda lift: not lift.hard),
        "per_object": objects,
        "lag_error_frames": rounded(known(lambda lift: lift.lag_error_frames).worst),
        "lag_ms": {lift.stem: round(1e3 * lift.lag_s, 1) for lift in lifts if lift.lag_unknown is None},
        "lag_unknown": {lift.stem: lift.lag_unknown for lift in lifts if lift.lag_unknown is not None},
        "aruco_error_mean_deg": rounded(known(lambda lift: lift.marker_error_mean_deg).mean),
        "aruco_error_worst_deg": rounded(known(lambda lift: lift.marker_error_worst_deg).worst),
        "camera_gaps": sum(lift.camera_gaps for lift in lifts),
        "dice": statistics(dices) if dices else None,
        "iou": statistics(ious) if ious else None,
        "networks": None,  # `python -m tests.campaigns network-table --lifts` compares networks
        "problems": {lift.stem: lift.problem for lift in lifts if lift.problem is not None},
        "paper_real_cell_as_published": PAPER | {"dice": PAPER_DICE[0], "iou": PAPER_IOU[0]},
    }


def _object_json(lifts: list[LiftResult]) -> dict[str, Any]:
    return {
        "lifts": len(lifts),
        "seen": lifts[0].seen,
        "hard": lifts[0].hard or None,
        "declined_share": rounded(Figures.of(lift.declined_share for lift in lifts).mean),
        "turns_deg": [round(lift.final_rotation_deg, 2) for lift in lifts if lift.final_rotation_deg is not None],
        "fused": statistics(errors_of(lifts)),
    }
