"""What is inside a camera: focal length, centre, distortion; in a small JSON file, checked when it is read."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from slipguard.config_errors import first_complaint
from slipguard.errors import InputError


class Intrinsics(BaseModel):
    """Of one camera at one picture size. Lengths in pixels; distortion k1 k2 p1 p2 k3 as OpenCV counts them."""

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
    """How well the calibration's own pictures fitted."""

    @model_validator(mode="after")
    def _plausible(self) -> Self:
        """Field of view 10 to 150 degrees, square pixels, a centre near the middle."""
        if not 0.13 <= self.fx_px / self.width_px <= 6.0:
            raise ValueError(f"fx_px {self.fx_px:g} is no focal length for pictures {self.width_px} px wide")
        if not 0.8 <= self.fx_px / self.fy_px <= 1.25:
            raise ValueError(f"fx_px {self.fx_px:g} and fy_px {self.fy_px:g} differ too much for one lens")
        off_x, off_y = self.cx_px / self.width_px - 0.5, self.cy_px / self.height_px - 0.5
        if max(abs(off_x), abs(off_y)) > 0.25:
            raise ValueError(f"the centre ({self.cx_px:g}, {self.cy_px:g}) is far from the picture's middle")
        return self

    @property
    def focal_px(self) -> float:
        """Mean focal length."""
        return 0.5 * (self.fx_px + self.fy_px)

    def matrix(self) -> NDArray[np.float64]:
        """(3, 3) camera matrix."""
        return np.array([[self.fx_px, 0.0, self.cx_px], [0.0, self.fy_px, self.cy_px], [0.0, 0.0, 1.0]])

    def rays(self, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
        """(n, 2) pixels to normalised coordinates of an ideal lens."""
        undistorted = cv2.undistortPoints(points_px.reshape(-1, 1, 2), self.matrix(), np.array(self.distortion))
        return np.asarray(undistorted.reshape(-1, 2), np.float64)

    def check_size(self, width_px: int, height_px: int, what: str) -> None:
        """Raises InputError where pictures have another size than the calibration's."""
        if (width_px, height_px) != (self.width_px, self.height_px):
            raise InputError(
                f"{what} is {width_px}x{height_px}, the intrinsics are for {self.width_px}x{self.height_px}; calibrate "
                "the camera at the size it records with"
            )


def read_intrinsics(path: Path) -> Intrinsics:
    """Raises InputError in one line."""
    try:
        return Intrinsics.model_validate_json(path.read_bytes())
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); make it with `slipguard evaluate calibrate-camera`"
        ) from None
    except ValidationError as error:
        raise InputError(f"{path}: no camera intrinsics: {first_complaint(error, Intrinsics)}") from None
