"""From a lift's recording to its errors: what slipguard said beside what the markers say."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import dice, iou
from slipguard.devices import Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.evaluation.clock_alignment import LAG_MAX_S, ClockLag, between_frames, find_lag
from slipguard.evaluation.lift_data import LiftData, TimedImage
from slipguard.evaluation.marker_detector import MarkerDetector
from slipguard.evaluation.marker_rotation import RotationTrace, rotations
from slipguard.evaluation.single_estimators import PatchRecorder, TimedPatch, rotations_by_estimator
from slipguard.evaluation.video_files import FILMS, markers_in
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.sim_lifts.lift_record import IMAGE_SIGN, EstimatedRotation
from slipguard.tools.replay import recorded_settings

Array = NDArray[np.float64]
MASK_GAP_S = 0.012
STILL_S = 0.3
"""The object lies still at least so long before the lift begins; both zeros are taken then."""
ZERO_S, ZERO_FRAMES_MIN = 0.15, 3
"""The markers' zero is their mean within this of slipguard's reference, over so many pictures at least."""
SENSE_DEG = 3.0
CURVE_POINTS = 300
FILM_LAG_MAX_S = 60.0
"""A film that somebody recorded beside it began within this of the lift."""


@dataclass(slots=True)
class RotationErrors:
    """Of one source against the markers. n: frames compared. The rest is None where n is 0."""

    n: int = 0
    mean_deg: float | None = None
    rms_deg: float | None = None
    worst_deg: float | None = None
    final_deg: float | None = None
    """At the end of the lift, signed."""


@dataclass(slots=True)
class LiftResult:
    """Everything a report needs of one lift; plain numbers, so that it can be kept as JSON."""

    stem: str
    object: str
    seen: bool
    hard: str
    repeat: int
    number: int
    simulated: bool = False
    final_rotation_deg: float | None = None
    """By the markers."""
    lag_s: float = 0.0
    lag_sigma_s: float = 0.0
    lag_unknown: str | None = None
    lag_error_frames: float | None = None
    camera_frames: int = 0
    camera_gaps: int = 0
    camera_rms_px: float | None = None
    marker_error_mean_deg: float | None = None
    marker_error_worst_deg: float | None = None
    declined_share: float = 0.0
    errors: dict[str, RotationErrors] = field(default_factory=dict)
    unaligned_mean_deg: float | None = None
    """The fused error with the lag left in."""
    within_1_sigma: float | None = None
    within_2_sigma: float | None = None
    dice: list[float] = field(default_factory=list)
    iou: list[float] = field(default_factory=list)
    curves: dict[str, list[list[float]]] = field(default_factory=dict)
    """Name -> [times, turns], seconds since the lift began."""
    problem: str | None = None
    """Why there is nothing to compare with."""

    def as_json(self) -> dict[str, Any]:
        """A plain dictionary."""
        return asdict(self)


def result_from_json(raw: dict[str, Any]) -> LiftResult:
    """The way back; raises TypeError on what is none."""
    return LiftResult(**raw | {"errors": {name: RotationErrors(**one) for name, one in raw["errors"].items()}})


def analyse(data: LiftData) -> LiftResult:
    """Compare all sources of one lift with its markers; what cannot be compared has its reason in `problem`."""
    about = data.about
    result = LiftResult(data.path.stem, about.object, about.seen, about.hard, about.repeat, about.number)
    result.simulated = about.camera_lag_s is not None
    began_s = data.phase_began_s("lifting")
    if began_s is None:
        raise InputError(f"{data.path}: no lift is in it")
    result.declined_share = data.declined / data.held if data.held else 1.0
    _score_masks(data, result)
    fused = np.array(data.fused).reshape(-1, 3)
    try:
        trace = _marker_rotations(data, began_s)
        result.camera_frames, result.camera_gaps = len(trace.time_s), trace.gaps
        result.camera_rms_px = trace.rms_px
        lag = find_lag(
            trace.time_s, trace.rotation_deg, fused[:, 0], fused[:, 1], LAG_MAX_S if data.camera else FILM_LAG_MAX_S
        )
        _tell_lag(data, result, lag, trace)
        camera_s = trace.time_s - lag.lag_s
        zero_s = float(fused[0, 0]) if len(fused) else began_s - STILL_S
        marker_deg = trace.rotation_deg - _level(camera_s, trace.rotation_deg, zero_s, began_s)
        _check_sense(fused, camera_s, marker_deg)
    except InputError as problem:
        result.problem = str(problem)
        return result
    result.final_rotation_deg = float(marker_deg[-1])
    _compare_truth(data, result, trace)
    _curve(result, "markers", camera_s - began_s, marker_deg)
    told = [EstimatedRotation(*row) for row in fused[fused[:, 0] >= began_s - STILL_S].tolist()]
    for name, stated in {"fused": told, **_estimators(data, began_s)}.items():
        time_s = np.array([one.captured_at_s for one in stated])
        rotation_deg = np.array([one.rotation_deg for one in stated])
        if name != "fused":  # they count from just before the lift
            rotation_deg = rotation_deg + float(np.interp(began_s - STILL_S, camera_s, marker_deg))
        compared = between_frames(time_s, camera_s) & (time_s >= began_s)
        error = rotation_deg[compared] - np.interp(time_s[compared], camera_s, marker_deg)
        result.errors[name] = _summed(error)
        _curve(result, name, time_s - began_s, rotation_deg)
        if name == "fused" and error.size:
            _judge_sigma(result, error, np.array([one.sigma_deg for one in stated])[compared])
            late = between_frames(time_s, trace.time_s) & (time_s >= began_s)
            if late.any():
                left_in = rotation_deg[late] - np.interp(time_s[late], trace.time_s, marker_deg)
                result.unaligned_mean_deg = float(np.abs(left_in).mean())
    return result


def _level(camera_s: Array, rotation_deg: Array, zero_s: float, began_s: float) -> float:
    """The markers' turn where slipguard took its reference, the object at rest: their zero too."""
    still = (camera_s >= zero_s - ZERO_S) & (camera_s <= min(zero_s + ZERO_S, began_s))
    if still.sum() < ZERO_FRAMES_MIN:
        raise InputError("the markers were not seen while the object was at rest, before the lift began")
    return float(rotation_deg[still].mean())


def _check_sense(fused: Array, camera_s: Array, marker_deg: Array) -> None:
    """Raises InputError where the markers turn the other way than the fingers, and by much."""
    inside = between_frames(fused[:, 0], camera_s)
    if inside.sum() < 5 or np.ptp(marker_deg) < SENSE_DEG or np.ptp(fused[inside, 1]) < SENSE_DEG:
        return
    beside = np.interp(fused[inside, 0], camera_s, marker_deg)
    if np.corrcoef(fused[inside, 1], beside)[0, 1] < -0.8:
        raise InputError(
            "the markers turn the other way than the fingers say; does the camera stand behind the finger that "
            "camera_side names?"
        )


def _marker_rotations(data: LiftData, began_s: float) -> RotationTrace:
    """The markers' turn in the left picture's sign, from when the object lay still."""
    if data.camera:
        detector = MarkerDetector()
        from_s = (data.fused[0][0] if data.fused else began_s) - 2.0 * STILL_S
        shown = [one for one in data.camera if one.time_s >= from_s]
        if not shown:
            raise InputError("no picture of the external camera shows the lift")
        first = shown[0].picture.pixels()
        data.intrinsics.check_size(first.shape[1], first.shape[0], "the camera's picture")
        seen = [detector.look(one.picture.pixels(), one.time_s) for one in shown]
    else:
        films = [data.path.with_suffix(ending) for ending in FILMS if data.path.with_suffix(ending).exists()]
        if not films:
            raise InputError(f"no external camera in the recording, and no film {data.path.stem}.mp4 beside it")
        # A film has a clock of its own; its zero is put where the lift begins, and the lag tells the rest.
        seen = list(markers_in(films[0], data.intrinsics, start_s=began_s))
    try:
        trace = rotations(seen, data.intrinsics, data.about.marker_side_mm)
    except np.linalg.LinAlgError:
        raise InputError("the markers' corners do not make squares; are they flat and whole?") from None
    sign = IMAGE_SIGN[data.about.camera_side]
    return RotationTrace(trace.time_s, sign * trace.rotation_deg, trace.sigma_deg, trace.gaps, trace.rms_px)


def _tell_lag(data: LiftData, result: LiftResult, lag: ClockLag, trace: RotationTrace) -> None:
    """Note the lag down. Raises InputError where without it there is no common clock."""
    result.lag_s, result.lag_sigma_s, result.lag_unknown = lag.lag_s, lag.sigma_s, lag.why
    if lag.why is not None and (not data.camera or not data.fused):
        raise InputError(f"the lag between film and fingers cannot be told ({lag.why}), so there is no common clock")
    if data.about.camera_lag_s is not None and lag.why is None and len(trace.time_s) > 1:
        frame_s = float(np.median(np.diff(trace.time_s)))
        result.lag_error_frames = abs(lag.lag_s - data.about.camera_lag_s) / frame_s


def _compare_truth(data: LiftData, result: LiftResult, trace: RotationTrace) -> None:
    """The markers themselves against a simulated world, without any lag to find."""
    time_s, true_deg = data.true_rotations()
    if data.about.camera_lag_s is None or len(time_s) < 2:
        return
    error = trace.rotation_deg - np.interp(trace.time_s - data.about.camera_lag_s, time_s, true_deg)
    error -= error[:10].mean()  # both count from where the object lay still
    result.marker_error_mean_deg = float(np.abs(error).mean())
    result.marker_error_worst_deg = float(np.abs(error).max())
    began_s = data.phase_began_s("lifting") or 0.0
    _curve(result, "truth", time_s - began_s, true_deg - float(np.interp(began_s, time_s, true_deg)))


def _summed(error: Array) -> RotationErrors:
    if not error.size:
        return RotationErrors()
    size = np.abs(error)
    return RotationErrors(
        error.size, float(size.mean()), float(np.sqrt((error**2).mean())), float(size.max()), float(error[-1])
    )


def _judge_sigma(result: LiftResult, error: Array, sigma_deg: Array) -> None:
    scaled = np.abs(error) / sigma_deg
    result.within_1_sigma, result.within_2_sigma = float((scaled <= 1.0).mean()), float((scaled <= 2.0).mean())


def _estimators(data: LiftData, began_s: float) -> dict[str, list[EstimatedRotation]]:
    """What each plain estimator says of the recorded frames: the mean of both fingers, frame by frame of the left."""
    kept: list[TimedPatch] = []
    settings = recorded_settings(data.recording)
    segmenter = Segmenter()
    for finger, frames in data.fingers.items():
        pipeline = Pipeline(
            segmenter,
            settings.perception,
            settings.background(finger),
            settings.noise_bgr(finger),
            settings.px_per_mm[finger],
            settings.mounting_deg[finger],
        )
        keeper = PatchRecorder(finger, pipeline, kept)
        for one in frames:
            if one.judged.new_reference:
                keeper.reset_reference()
            if one.picture is None:
                continue
            try:
                keeper.process(Frame(one.picture.pixels(), one.judged.captured_at_s, one.judged.sequence))
            except FrameCorrupt:
                continue
    by_estimator = rotations_by_estimator(kept, began_s - STILL_S, float("inf"))
    return {name: _together(fingers) for name, fingers in by_estimator.items()}


def _together(fingers: list[list[EstimatedRotation]]) -> list[EstimatedRotation]:
    """Both fingers' turns, weighted by their sigmas, at the times of the one that says more."""
    told = sorted((one for one in fingers if one), key=len, reverse=True)
    if len(told) < 2:
        return told[0] if told else []
    first, second = told
    other_s = np.array([one.captured_at_s for one in second])
    other_deg = np.array([one.rotation_deg for one in second])
    together = []
    for one in first:
        beside = int(np.argmin(np.abs(other_s - one.captured_at_s)))
        if abs(other_s[beside] - one.captured_at_s) > 0.05:
            together.append(one)
            continue
        a, b = one.sigma_deg**-2, second[beside].sigma_deg ** -2
        at_deg = float(np.interp(one.captured_at_s, other_s, other_deg))
        together.append(
            EstimatedRotation(one.captured_at_s, (a * one.rotation_deg + b * at_deg) / (a + b), (a + b) ** -0.5)
        )
    return together


def _score_masks(data: LiftData, result: LiftResult) -> None:
    """Dice and IoU of the masks found, against the true ones nearest in time."""
    for finger, true_masks in data.true_masks.items():
        found = data.masks[finger]
        if not found:
            continue
        times = np.array([one.time_s for one in found])
        for true in true_masks:
            near = int(np.argmin(np.abs(times - true.time_s)))
            if abs(times[near] - true.time_s) <= MASK_GAP_S:
                ours, theirs = mask_of(found[near]), mask_of(true)
                result.dice.append(dice(ours, theirs))
                result.iou.append(iou(ours, theirs))


def mask_of(one: TimedImage) -> NDArray[np.bool_]:
    """(320, 240) bool."""
    return np.asarray(one.picture.pixels()[..., 0] > 127)


def _curve(result: LiftResult, name: str, time_s: Array, rotation_deg: Array) -> None:
    step = max(len(time_s) // CURVE_POINTS, 1)
    result.curves[name] = [np.round(time_s[::step], 4).tolist(), np.round(rotation_deg[::step], 4).tolist()]
