"""Perception on image files: what `slipguard measure` reports for each frame."""

from __future__ import annotations

import time
from array import array
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.perception.axis import estimate_axis
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.tools.figures import rounded
from slipguard.tools.image_files import FileFrame, find_image_files, read_frames

PX_PER_MM = 18.5
"""Scale of a DIGIT at 240 x 320; only shifts depend on it."""
SINGLE = "single frame: only the orientation is known"
ENDS = 30
"""Rows of a table before and after those that are left out."""


@dataclass(frozen=True, slots=True, eq=False)
class FrameMeasurement:
    """One frame with its estimate and mask, (320, 240) uint8, 0 or 1.

    reference: name of the frame that the rotation counts from; None before.
    """

    frame: FileFrame
    estimate: Estimate
    mask: NDArray[np.uint8]
    reference: str | None


def measure(
    paths: list[Path],
    segmenter: Segmenter,
    settings: PerceptionSettings,
    background: NDArray[np.uint8] | None,
    independent: bool,
) -> Iterator[FrameMeasurement]:
    """Yield the estimate of each frame, of one recording or, if `independent`, of single frames.

    Without a background image only the axis estimators apply.

    Raises:
        InputError: At the first file that cannot be used, after the frames before it were yielded.
    """
    pipeline = _pipeline(segmenter, settings, background)
    reference: str | None = None
    for sequence, frame in enumerate(read_frames(find_image_files(paths))):
        if independent and sequence:
            pipeline, reference = _pipeline(segmenter, settings, background), None
        try:
            estimate = pipeline.process(Frame(frame.image, frame.captured_at_s, sequence))
        except FrameCorrupt as error:
            raise InputError(f"{frame.name}: {error}") from error
        patch = pipeline.last_patch
        if independent and estimate.contact and patch is not None:  # without a reference, the axis is all there is
            axis = estimate_axis(patch, "moments" if settings.estimator == "registration" else settings.estimator)
            estimate = replace(estimate, orientation_deg=axis.angle_deg, declined=SINGLE)
        if reference is None and pipeline.has_reference:
            reference = frame.name
        mask = pipeline.last_mask.copy() if estimate.contact else np.zeros(frame.image.shape[:2], np.uint8)
        yield FrameMeasurement(frame, estimate, mask, reference)


def _pipeline(segmenter: Segmenter, settings: PerceptionSettings, background: NDArray[np.uint8] | None) -> Pipeline:
    return Pipeline(segmenter, settings, background, None, PX_PER_MM, timer=time.perf_counter)


def as_json(measured: FrameMeasurement) -> dict[str, Any]:
    estimate = measured.estimate
    return {
        "frame": measured.frame.name,
        "contact": estimate.contact,
        "contact_area_px": estimate.contact_area_px,
        "angle_deg": rounded(estimate.rotation_deg),
        "orientation_deg": rounded(estimate.orientation_deg),
        "sigma_deg": rounded(estimate.sigma_deg),
        "reference": measured.reference,
        "method": estimate.method,
        "skipped": estimate.skipped,
        "declined": estimate.declined,
        "stage_ms": {stage: round(spent_ms, 3) for stage, spent_ms in estimate.stage_ms.items()},
    }


def write_mask(folder: Path, measured: FrameMeasurement) -> None:
    """Write the mask to `<stem>.png`, 0 or 255, in the size of the source frame. Raises `InputError` if that fails."""
    size = (measured.frame.width_px, measured.frame.height_px)
    mask = measured.mask * np.uint8(255)
    if (mask.shape[1], mask.shape[0]) != size:
        mask = np.asarray(cv2.resize(mask, size, interpolation=cv2.INTER_NEAREST), np.uint8)
    path = folder / f"{measured.frame.stem}.png"
    data = cv2.imencode(".png", mask)[1].tobytes()
    try:
        path.write_bytes(data)
    except OSError as error:
        raise InputError(f"{path}: cannot write the mask: {error.strerror}") from error


class Results:
    """What table and plot show of all frames. Images and masks are not kept: a video may have any number of frames.

    first, last: names and estimates of at most `ENDS` frames at the beginning and at the end.
    """

    def __init__(self) -> None:
        self.first: list[tuple[str, Estimate]] = []
        self.last: deque[tuple[str, Estimate]] = deque(maxlen=ENDS)
        self.count, self.in_contact = 0, 0
        self._columns = {name: array("d") for name in ("rotation", "sigma", "orientation", "area")}

    def add(self, name: str, estimate: Estimate) -> None:
        """Add the next frame."""
        (self.first if self.count < ENDS else self.last).append((name, estimate))
        self.count += 1
        self.in_contact += estimate.contact
        given = (estimate.rotation_deg, estimate.sigma_deg, estimate.orientation_deg, estimate.contact_area_px)
        for column, value in zip(self._columns.values(), given, strict=True):
            column.append(np.nan if value is None else value)

    def column(self, name: str) -> NDArray[np.float64]:
        """Return rotation, sigma or orientation in degrees, or the contact area in pixels; NaN where it is declined."""
        return np.frombuffer(self._columns[name], np.float64)


def plot(results: Results, path: Path, background_known: bool) -> None:
    """Plot rotation with its uncertainty, orientation and contact area of the frames into an image file."""
    from slipguard.tools.plotting import figure, save

    drawing = figure(9.0, 6.5)
    rotation, axis, area = drawing.subplots(3, 1, sharex=True, height_ratios=(3, 2, 1))
    number = np.arange(results.count)
    angle, sigma = results.column("rotation"), results.column("sigma")
    rotation.fill_between(number, angle - 2.0 * sigma, angle + 2.0 * sigma, alpha=0.25, label="± 2 sigma")
    rotation.plot(number, angle, marker=".", label="rotation since the reference")
    rotation.set_ylabel("rotation, degrees (ccw +)")
    rotation.legend(loc="best")
    axis.plot(number, results.column("orientation"), ".", color="tab:green")
    axis.set_ylabel("orientation, degrees")
    axis.set_ylim(-95.0, 95.0)
    area.plot(number, results.column("area"), color="tab:gray")
    area.set_ylabel("contact area, px")
    ends = [*results.first, *results.last]
    area.set_xlabel(f"frame, from {ends[0][0]} to {ends[-1][0]}")
    rotation.set_title(
        "with the sensor's background image" if background_known else "axis of the mask, without a background image"
    )
    for axes in (rotation, axis, area):
        axes.grid(alpha=0.3)
    save(drawing, path)
