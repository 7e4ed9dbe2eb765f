"""Typed image operations of the renderer: float32 in, float32 out."""

from __future__ import annotations

from typing import Any, cast

import cv2
import numpy as np
from numpy.typing import NDArray

Field = NDArray[np.float32]


def f32(values: Any) -> Field:
    """Return the values as a float32 array, without a copy if they are one."""
    return np.asarray(values, np.float32)


def blurred(image: Field, sigma_px: float) -> Field:
    """Return a Gaussian blur, any number of channels; the border is mirrored."""
    return cast("Field", cv2.GaussianBlur(image, (0, 0), sigma_px))


def enlarged(image: Field, size: tuple[int, int]) -> Field:
    """Interpolate linearly to (width, height); pixel areas correspond."""
    return cast("Field", cv2.resize(image, size, interpolation=cv2.INTER_LINEAR))


def reduced(image: Field, size: tuple[int, int]) -> Field:
    """Average over pixel areas, to (width, height)."""
    return cast("Field", cv2.resize(image, size, interpolation=cv2.INTER_AREA))


def warped(image: Field, to_source: NDArray[np.float64], size: tuple[int, int]) -> Field:
    """Sample linearly at to_source @ (column, row, 1); the border pixels extend outwards. size: (width, height)."""
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cast("Field", cv2.warpAffine(image, to_source, size, flags=flags, borderMode=cv2.BORDER_REPLICATE))
