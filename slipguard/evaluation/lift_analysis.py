"""From a lift's recording to its errors: slipguard's rotation estimates compared with the markers' rotation."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError
from slipguard.evaluation.clock_alignment import LAG_MAX_S, ClockLag, between_frames, find_lag
from slipguard.evaluation.external_camera import markers_in
from slipguard.evaluation.lift_recording import LiftData, TimedImage
from slipguard.evaluation.marker_rotation import RotationTrace, rotations
from slipguard.evaluation.markers import MarkerDetector
from slipguard.sim_lifts.lift_record import IMAGE_SIGN
from slipguard.tools.image_files import VIDEO_ENDINGS

Array = NDArray[np.float64]
MASK_GAP_S = 0.012
STILL_S = 0.3
"""The object rests at least this long before the lift begins; both zeros are taken then."""
ZERO_S, ZERO_FRAMES_MIN = 0.15, 3
"""The markers' zero is their mean within ZERO_S of slipguard's reference, over at least ZERO_FRAMES_MIN images."""
DIRECTION_MIN_DEG = 3.0
CURVE_POINTS = 300
VIDEO_LAG_MAX_S = 60.0
"""Maximum offset between the start of a separately recorded video and the lift."""


@dataclass(slots=True)
class RotationErrors:
    """Errors of one source against the markers. n: frames compared. The rest is None if n is 0."""

    n: int = 0
    mean_deg: float | None = None
    worst_deg: float | None = None


@dataclass(slots=True)
class LiftResult:
    """All a report needs of one lift, as plain numbers that can be stored as JSON."""

    stem: str
    object: str
    seen: bool
    hard: str
    repeat: int
    number: int
    simulated: bool = False
    final_rotation_deg: float | None = None
    """Measured by the markers."""
    lag_s: float = 0.0
    lag_unknown: str | None = None
    lag_error_frames: float | None = None
    camera_gaps: int = 0
    marker_error_mean_deg: float | None = None
    marker_error_worst_deg: float | None = None
    declined_share: float = 0.0
    errors: dict[str, RotationErrors] = field(default_factory=dict)
    unaligned_mean_deg: float | None = None
    """The fused error without removing the lag."""
    within_1_sigma: float | None = None
    within_2_sigma: float | None = None
    dice: list[float] = field(default_factory=list)
    iou: list[float] = field(default_factory=list)
    curves: dict[str, list[list[float]]] = field(default_factory=dict)
    """Name -> [times, rotations], seconds since the lift began."""
    problem: str | None = None
    """Why the lift cannot be compared."""

    def as_json(self) -> dict[str, Any]:
        return asdict(self)


def result_from_json(raw: dict[str, Any]) -> LiftResult:
    """Return the result of a dictionary by `as_json`; raise TypeError for another."""
    return LiftResult(**raw | {"errors": {name: RotationErrors(**one) for name, one in raw["errors"].items()}})


def analyze(data: LiftData) -> LiftResult:
    """Compare the estimates of one lift with its markers; if that is impossible, `problem` holds the reason."""
    about = data.about
    result = LiftResult(data.path.stem, about.object, about.seen, about.hard, about.repeat, about.number)
    result.simulated = about.camera_lag_s is not None
    began_s = data.phase_began_s("lifting")
    if began_s is None:
        raise InputError(f"{data.path}: contains no lift")
    result.declined_share = data.declined / data.held if data.held else 1.0
    _score_masks(data, result)
    fused = np.array(data.fused).reshape(-1, 3)
    try:
        trace = _marker_rotations(data, began_s)
        result.camera_gaps = trace.gaps
        lag = find_lag(
            trace.time_s, trace.rotation_deg, fused[:, 0], fused[:, 1], LAG_MAX_S if data.camera else VIDEO_LAG_MAX_S
        )
        _set_lag(data, result, lag, trace)
        camera_s = trace.time_s - lag.lag_s
        zero_s = float(fused[0, 0]) if len(fused) else began_s - STILL_S
        marker_deg = trace.rotation_deg - _zero_deg(camera_s, trace.rotation_deg, zero_s, began_s)
        _check_direction(fused, camera_s, marker_deg)
    except InputError as problem:
        result.problem = str(problem)
        return result
    result.final_rotation_deg = float(marker_deg[-1])
    _compare_truth(data, result, trace)
    _curve(result, "markers", camera_s - began_s, marker_deg)
    time_s, rotation_deg, sigma_deg = fused[fused[:, 0] >= began_s - STILL_S].T
    compared = between_frames(time_s, camera_s) & (time_s >= began_s)
    error = rotation_deg[compared] - np.interp(time_s[compared], camera_s, marker_deg)
    result.errors["fused"] = _statistics(error)
    _curve(result, "fused", time_s - began_s, rotation_deg)
    if error.size:
        scaled = np.abs(error) / sigma_deg[compared]
        result.within_1_sigma, result.within_2_sigma = float((scaled <= 1.0).mean()), float((scaled <= 2.0).mean())
        uncorrected = between_frames(time_s, trace.time_s) & (time_s >= began_s)
        if uncorrected.any():
            error_with_lag = rotation_deg[uncorrected] - np.interp(time_s[uncorrected], trace.time_s, marker_deg)
            result.unaligned_mean_deg = float(np.abs(error_with_lag).mean())
    return result


def _zero_deg(camera_s: Array, rotation_deg: Array, zero_s: float, began_s: float) -> float:
    """Return the markers' rotation at the time of slipguard's reference, the object at rest."""
    still = (camera_s >= zero_s - ZERO_S) & (camera_s <= min(zero_s + ZERO_S, began_s))
    if still.sum() < ZERO_FRAMES_MIN:
        raise InputError("the markers were not visible while the object was at rest, before the lift")
    return float(rotation_deg[still].mean())


def _check_direction(fused: Array, camera_s: Array, marker_deg: Array) -> None:
    """Raise InputError if the markers rotate clearly in the opposite direction."""
    inside = between_frames(fused[:, 0], camera_s)
    if inside.sum() < 5 or np.ptp(marker_deg) < DIRECTION_MIN_DEG or np.ptp(fused[inside, 1]) < DIRECTION_MIN_DEG:
        return
    marker_at_fused_deg = np.interp(fused[inside, 0], camera_s, marker_deg)
    if np.corrcoef(fused[inside, 1], marker_at_fused_deg)[0, 1] < -0.8:
        raise InputError(
            "the markers rotate in the opposite direction to the fingers' estimate; check that the camera is behind "
            "the finger named by camera_side"
        )


def _marker_rotations(data: LiftData, began_s: float) -> RotationTrace:
    """Return the markers' rotation in the left image's sign, from when the object was at rest."""
    if data.camera:
        detector = MarkerDetector()
        from_s = (data.fused[0][0] if data.fused else began_s) - 2.0 * STILL_S
        images = [one for one in data.camera if one.time_s >= from_s]
        if not images:
            raise InputError("no image of the external camera shows the lift")
        first = images[0].image.pixels()
        data.intrinsics.check_size(first.shape[1], first.shape[0], "the camera's image")
        corners = [detector.detect(one.image.pixels(), one.time_s) for one in images]
    else:
        videos = [path for ending in sorted(VIDEO_ENDINGS) if (path := data.path.with_suffix(ending)).exists()]
        if not videos:
            raise InputError(f"no external camera in the recording, and no video {data.path.stem}.mp4 next to it")
        # A video has its own clock: start it where the lift begins; the lag is found afterwards.
        corners = list(markers_in(videos[0], data.intrinsics, start_s=began_s))
    try:
        trace = rotations(corners, data.intrinsics, data.about.marker_side_mm)
    except np.linalg.LinAlgError:
        raise InputError("the markers' corners are not square; are the markers flat and undamaged?") from None
    sign = IMAGE_SIGN[data.about.camera_side]
    return RotationTrace(trace.time_s, sign * trace.rotation_deg, trace.sigma_deg, trace.gaps, trace.rms_px)


def _set_lag(data: LiftData, result: LiftResult, lag: ClockLag, trace: RotationTrace) -> None:
    """Store the lag in the result. Raises InputError if there is no common clock without it."""
    result.lag_s, result.lag_unknown = lag.lag_s, lag.why
    if lag.why is not None and (not data.camera or not data.fused):
        raise InputError(
            f"the lag between video and fingers cannot be determined ({lag.why}), so there is no common clock"
        )
    if data.about.camera_lag_s is not None and lag.why is None and len(trace.time_s) > 1:
        frame_s = float(np.median(np.diff(trace.time_s)))
        result.lag_error_frames = abs(lag.lag_s - data.about.camera_lag_s) / frame_s


def _compare_truth(data: LiftData, result: LiftResult, trace: RotationTrace) -> None:
    """Compare the markers with a simulated world's truth; the lag is known there."""
    time_s, true_deg = data.true_rotations()
    if data.about.camera_lag_s is None or len(time_s) < 2:
        return
    error = trace.rotation_deg - np.interp(trace.time_s - data.about.camera_lag_s, time_s, true_deg)
    error -= error[:10].mean()  # both are relative to the object at rest
    result.marker_error_mean_deg = float(np.abs(error).mean())
    result.marker_error_worst_deg = float(np.abs(error).max())
    began_s = data.phase_began_s("lifting") or 0.0
    _curve(result, "truth", time_s - began_s, true_deg - float(np.interp(began_s, time_s, true_deg)))


def _statistics(error: Array) -> RotationErrors:
    if not error.size:
        return RotationErrors()
    size = np.abs(error)
    return RotationErrors(error.size, float(size.mean()), float(size.max()))


def _score_masks(data: LiftData, result: LiftResult) -> None:
    """Compute Dice and IoU of the segmented masks against the true masks nearest in time."""
    for finger, true_masks in data.true_masks.items():
        found = data.masks[finger]
        if not found:
            continue
        times = np.array([one.time_s for one in found])
        for true in true_masks:
            near = int(np.argmin(np.abs(times - true.time_s)))
            if abs(times[near] - true.time_s) <= MASK_GAP_S:
                segmented, truth = mask_of(found[near]), mask_of(true)
                result.dice.append(dice(segmented, truth))
                result.iou.append(iou(segmented, truth))


def mask_of(one: TimedImage) -> NDArray[np.bool_]:
    return np.asarray(one.image.pixels()[..., 0] > 127)


def _curve(result: LiftResult, name: str, time_s: Array, rotation_deg: Array) -> None:
    step = max(len(time_s) // CURVE_POINTS, 1)
    result.curves[name] = [np.round(time_s[::step], 4).tolist(), np.round(rotation_deg[::step], 4).tolist()]
