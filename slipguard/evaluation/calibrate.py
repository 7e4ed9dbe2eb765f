"""A camera's intrinsics from pictures of the printed ChArUco board."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.intrinsics import Intrinsics
from slipguard.evaluation.markers import charuco

PICTURES_MIN, PICTURES_MAX = 6, 60
CORNERS_MIN = 8
RMS_MAX_PX = 1.5
TILT_MIN_DEG = 10.0
"""Boards all facing the camera the same way do not tell the focal length."""


def calibrate(pictures: Iterable[NDArray[np.uint8]]) -> Intrinsics:
    """Intrinsics from (h, w, 3) uint8 pictures of one size; the board's true scale does not matter.

    Raises InputError where too few pictures show the board, all show it alike, or nothing fits.
    """
    board = charuco()
    detector = cv2.aruco.CharucoDetector(board)
    seen: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    size: tuple[int, int] | None = None
    count = 0
    for picture in pictures:
        count += 1
        here = (picture.shape[1], picture.shape[0])
        if size is not None and here != size:
            raise InputError(f"pictures of two sizes: {size[0]}x{size[1]} and {here[0]}x{here[1]}; give one camera's")
        size = here
        corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY))
        if ids is not None and len(ids) >= CORNERS_MIN:
            points, pixels = board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
            seen.append((np.asarray(points, np.float32), np.asarray(pixels, np.float32)))
    if size is None or len(seen) < PICTURES_MIN:
        raise InputError(
            f"the board was seen in {len(seen)} of {count} pictures; at least {PICTURES_MIN} are needed, from "
            "different sides (print it with `slipguard evaluate markers --charuco`)"
        )
    chosen = [seen[int(k)] for k in np.linspace(0, len(seen) - 1, min(len(seen), PICTURES_MAX))]
    points_all, pixels_all = [one[0] for one in chosen], [one[1] for one in chosen]
    answer: Any = cv2.calibrateCamera(points_all, pixels_all, size, None, None)
    rms, matrix, distortion, rotations = answer[:4]
    if not np.isfinite(rms) or rms > RMS_MAX_PX:
        raise InputError(f"no lens explains these pictures (off by {rms:.1f} px); is the board flat, and in focus?")
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    spread = np.degrees(np.arccos(np.clip(np.min(normals @ normals.T), -1.0, 1.0)))
    if spread < TILT_MIN_DEG:
        raise InputError(
            f"all pictures show the board within {spread:.0f}° of the same tilt; tilt it by 30° to each side as well"
        )
    coefficients = [float(value) for value in np.ravel(distortion)[:5]]
    return Intrinsics(
        width_px=size[0], height_px=size[1], fx_px=float(matrix[0, 0]), fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]), cy_px=float(matrix[1, 2]),
        distortion=(coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4]),
        rms_px=round(float(rms), 4),
    )  # fmt: skip
