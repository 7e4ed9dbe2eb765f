"""The external camera's intrinsics: stored as JSON, found from images of the printed ChArUco board."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from slipguard.config_errors import describe_validation_error
from slipguard.errors import InputError
from slipguard.evaluation.markers import charuco

IMAGES_MIN, IMAGES_MAX = 6, 60
CORNERS_MIN = 8
RMS_MAX_PX = 1.5
TILT_MIN_DEG = 10.0
"""If all boards have the same tilt, the focal length is not observable."""


class Intrinsics(BaseModel):
    """Intrinsics at one image size. Lengths in pixels; distortion k1 k2 p1 p2 k3 as in OpenCV."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: Literal[1] = 1
    width_px: Annotated[int, Field(ge=64, le=20_000)]
    height_px: Annotated[int, Field(ge=64, le=20_000)]
    fx_px: Annotated[float, Field(gt=0.0)]
    fy_px: Annotated[float, Field(gt=0.0)]
    cx_px: float
    cy_px: float
    distortion: tuple[float, float, float, float, float] = (0.0, 0.0, 0.0, 0.0, 0.0)
    rms_px: Annotated[float, Field(ge=0.0)] | None = None
    """Reprojection error of the calibration."""

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        """Check for a field of view of 10 to 150 degrees, square pixels, and a center near the middle."""
        if not 0.13 <= self.fx_px / self.width_px <= 6.0:
            raise ValueError(f"fx_px {self.fx_px:g} is not a plausible focal length for images {self.width_px} px wide")
        if not 0.8 <= self.fx_px / self.fy_px <= 1.25:
            raise ValueError(f"fx_px {self.fx_px:g} and fy_px {self.fy_px:g} differ too much for one lens")
        off_x, off_y = self.cx_px / self.width_px - 0.5, self.cy_px / self.height_px - 0.5
        if max(abs(off_x), abs(off_y)) > 0.25:
            raise ValueError(f"the center ({self.cx_px:g}, {self.cy_px:g}) is far from the middle of the image")
        return self

    @property
    def focal_px(self) -> float:
        return 0.5 * (self.fx_px + self.fy_px)

    def matrix(self) -> NDArray[np.float64]:
        """Return the (3, 3) camera matrix."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def rays(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the (n, 2) normalized coordinates of (n, 2) pixels, without distortion."""
        undistorted = cv2.undistortPoints(points_px.reshape(-1, 1, 2), self.matrix(), np.array(self.distortion))
        return np.asarray(undistorted.reshape(-1, 2), np.float64)

    def check_size(self, width_px: int, height_px: int, what: str) -> None:
        """Raise InputError if images have another size than the calibration's."""
        if (width_px, height_px) != (self.width_px, self.height_px):
            raise InputError(
                f"{what} is {width_px}x{height_px}, the intrinsics are for {self.width_px}x{self.height_px}; calibrate "
                "the camera at the size it records with"
            )


def read_intrinsics(path: Path) -> Intrinsics:
    """Return the intrinsics of a file; raise InputError if there are none."""
    try:
        return Intrinsics.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); make it with `slipguard evaluate calibrate-camera`"
        ) from None
    except ValidationError as error:
        raise InputError(f"{path}: no camera intrinsics: {describe_validation_error(error, Intrinsics)}") from None


def calibrate_camera(images: Iterable[NDArray[np.uint8]]) -> Intrinsics:
    """Return the intrinsics from (h, w, 3) uint8 images of one size; the board's true scale does not matter.

    Raises InputError if too few images show the board, all show it with the same tilt, or the fit is poor.
    """
    board = charuco()
    detector = cv2.aruco.CharucoDetector(board)
    found: list[tuple[NDArray[np.float32], NDArray[np.float32]]] = []
    size: tuple[int, int] | None = None
    count = 0
    for image in images:
        count += 1
        here = (image.shape[1], image.shape[0])
        if size is not None and here != size:
            raise InputError(f"images of two sizes: {size[0]}x{size[1]} and {here[0]}x{here[1]}; use one camera's")
        size = here
        corners, ids, _, _ = detector.detectBoard(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))
        if ids is not None and len(ids) >= CORNERS_MIN:
            points, pixels = board.matchImagePoints(corners, ids)  # type: ignore[call-overload]
            found.append((np.asarray(points, np.float32), np.asarray(pixels, np.float32)))
    if size is None or len(found) < IMAGES_MIN:
        raise InputError(
            f"the board was found in {len(found)} of {count} images; at least {IMAGES_MIN} are needed, from different "
            "sides (print it with `slipguard evaluate markers --charuco`)"
        )
    chosen = [found[int(k)] for k in np.linspace(0, len(found) - 1, min(len(found), IMAGES_MAX))]
    result: Any = cv2.calibrateCamera([one[0] for one in chosen], [one[1] for one in chosen], size, None, None)
    rms, matrix, distortion, rotations = result[:4]
    if not np.isfinite(rms) or rms > RMS_MAX_PX:
        raise InputError(
            f"no lens model fits these images ({rms:.1f} px rms, limit {RMS_MAX_PX:g}); is the board flat?"
        )
    normals = np.array([cv2.Rodrigues(rotation)[0][:, 2] for rotation in rotations])
    tilts_deg = np.degrees(np.arccos(np.clip(np.min(normals @ normals.T), -1.0, 1.0)))
    if tilts_deg < TILT_MIN_DEG:
        raise InputError(
            f"all images show the board within {tilts_deg:.0f}° of the same tilt; tilt it by 30° to each side as well"
        )
    coefficients = [float(value) for value in np.ravel(distortion)[:5]]
    return Intrinsics(
        width_px=size[0], height_px=size[1], fx_px=float(matrix[0, 0]), fy_px=float(matrix[1, 1]),
        cx_px=float(matrix[0, 2]), cy_px=float(matrix[1, 2]),
        distortion=(coefficients[0], coefficients[1], coefficients[2], coefficients[3], coefficients[4]),
        rms_px=round(float(rms), 4),
    )  # fmt: skip
