"""Plain ways to an axis and a turn, as papers describe them: what slipguard's estimators are compared with."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.estimate import Estimate
from slipguard.perception.rotation.axial_angle import axial_difference_deg, wrap_axial_deg

MIN_AREA_PX = 200


class AxialRotation:
    """The turn since the first axis, the smaller way round: an axis that jumps does not spoil what comes after."""

    def __init__(self) -> None:
        self._first_deg: float | None = None

    def estimate(self, frame: Frame, axis_deg: float, area_px: int, method: str) -> Estimate:
        """What a pipeline without sigmas says of a frame; axis_deg NaN where there is none."""
        rotation_deg = None
        if math.isfinite(axis_deg) and area_px >= MIN_AREA_PX:
            if self._first_deg is None:
                self._first_deg = axis_deg
            rotation_deg = axial_difference_deg(axis_deg, self._first_deg)
        return Estimate(
            sequence=frame.sequence,
            captured_at_s=frame.captured_at_s,
            measured_at_s=frame.captured_at_s,
            contact=area_px >= MIN_AREA_PX,
            contact_area_px=area_px,
            method=method,
            angle_deg=rotation_deg,
            declined=None if rotation_deg is not None else "no axis",
        )


def axis_of_points(x: NDArray[np.intp], y: NDArray[np.intp]) -> float:
    """Direction of largest spread of pixels (right, down), degrees counter-clockwise as seen."""
    dx, dy = x - x.mean(), y - y.mean()
    return wrap_axial_deg(-math.degrees(math.atan2(2.0 * float(dx @ dy), float(dx @ dx - dy @ dy))) / 2.0)


def axis_of_ellipse(mask: NDArray[np.uint8]) -> float:
    """Long axis of an ellipse fitted to the longest outline; NaN where there is none."""
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    longest = max(outlines, key=len, default=None)
    if longest is None or len(longest) < 5:
        return math.nan
    _, (first, second), rotated = cv2.fitEllipse(longest)
    return wrap_axial_deg(-rotated if first >= second else -rotated - 90.0)
