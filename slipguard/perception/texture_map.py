"""The texture map: the gel's curvature in and around a contact, from the colors of a frame.

Each of the three lights brightens what slopes towards it, so colors show slopes. The divergence of the slopes is a
property of the object's surface and rotates with the object, while the lights stay where they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.perception.patch import Patch

REDUCTION = 2
"""Frame pixels per pixel of the texture map: finer detail is below the gel's and the camera's own blur."""
WIDTH_PX, HEIGHT_PX = FRAME_WIDTH_PX // REDUCTION, FRAME_HEIGHT_PX // REDUCTION
AROUND_PX = 12
"""The map extends this far around the patch's box: the slopes around a contact, and room for filters."""
LIGHTS_DEG = (270.0, 150.0, 30.0)
"""Azimuths of the blue, green and red light of a DIGIT, counter-clockwise from the image's right."""
BLUR_PX = 1.0
NOMINAL_WEIGHT = 1.0
"""Weight of the color mix of three equal lights in the learned one, as a share of the texture's energy."""
NOISE_SHARE = 0.175
"""Noise of the curvature over noise of a pixel, for colors equal to slopes: measured on frames of pure noise with the
sensor's correlation of 0.65 between neighboring pixels; white noise leaves less."""

Field = NDArray[np.float32]
_BLUR = np.asarray(cv2.getGaussianKernel(9, BLUR_PX), np.float32).ravel()
_SLOPE = np.convolve(_BLUR, [-0.5, 0.0, 0.5]).astype(np.float32)
_LEVEL = np.convolve(_BLUR, [0.25, 0.5, 0.25]).astype(np.float32)
"""Filters along rows and columns: blur; blur and derivative; blur and the mean that belongs to a derivative across."""


@dataclass(frozen=True, slots=True)
class ImageWindow:
    """A part of the texture map's image of 120 x 160: its first column and row, and those after its last."""

    left_px: int
    top_px: int
    right_px: int
    bottom_px: int

    @classmethod
    def around(cls, patch: Patch) -> ImageWindow:
        """Return the window of a patch's crop and its surroundings."""
        scale = patch.frame_px / REDUCTION
        rows, columns = patch.mask.shape
        return cls(
            max(math.floor(patch.left_px * scale) - AROUND_PX, 0),
            max(math.floor(patch.top_px * scale) - AROUND_PX, 0),
            min(math.ceil((patch.left_px + columns) * scale) + AROUND_PX, WIDTH_PX),
            min(math.ceil((patch.top_px + rows) * scale) + AROUND_PX, HEIGHT_PX),
        )


@dataclass(frozen=True, slots=True, eq=False)
class TextureMap:
    """Curvature in one window: (h, w) float32, gray levels per pixel.

    noise: effect of the camera's noise on an untouched gel, one standard deviation; 0 if unknown.
    """

    window: ImageWindow
    curvature: Field
    noise: float = 0.0


class TextureMapReader:
    """Reads texture maps from one finger's frames. Its only state is the color mix, which `learn` finds.

    Args:
        background: The unit's background image, (320, 240, 3) uint8 BGR.
        noise_bgr: Standard deviation of a pixel, gray levels; None if unknown.
    """

    def __init__(
        self, background: NDArray[np.uint8], noise_bgr: Sequence[float] | NDArray[np.floating] | None = None
    ) -> None:
        self._background = _half_size(background)
        self._noise_bgr = np.zeros(3) if noise_bgr is None else np.asarray(noise_bgr, np.float64)
        self._set_colors(_to_slopes(0.0, mirrored=False))

    def _set_colors(self, colors: NDArray[np.float32]) -> None:
        self._colors = colors
        self._noise = NOISE_SHARE * float(np.linalg.norm(colors * self._noise_bgr))

    def learn(self, image: NDArray[np.uint8], patch: Patch) -> None:
        """Find the mix of colors that gives slopes, from a frame with contact.

        First the lights' sense and common rotation: with slopes s = sx + i sy by lights in the right sense,
        (d/dx - i d/dy) s is real wherever the gel is a surface, except for one factor by which all azimuths are off; in
        the wrong sense its phase varies. Then strengths and cross-talk: slopes of a surface have no curl.
        """
        steep = self._steepness(image, ImageWindow.around(patch), patch)
        found = []
        for mirrored in (False, True):
            x, y = _to_slopes(0.0, mirrored).astype(np.float64)
            along, across = np.concatenate([x, y]), np.concatenate([y, -x])  # of d/dx and d/dy of every color
            re2, im2 = float(along @ steep @ along), float(across @ steep @ across)
            square = complex(re2 - im2, 2.0 * float(along @ steep @ across))
            found.append((abs(square) / max(re2 + im2, 1e-9), math.atan2(square.imag, square.real) / 2))
        mirrored = found[1][0] > found[0][0]
        self._set_colors(_without_curl(steep, _to_slopes(found[int(mirrored)][1], mirrored)))

    def _steepness(self, image: NDArray[np.uint8], window: ImageWindow, patch: Patch) -> NDArray[np.float64]:
        """Return products of the three colors' change to the right and upwards, summed over the patch: (6, 6)."""
        smooth = _filtered(self._colors_in(image, window), _BLUR, _BLUR)
        every_second = np.s_[::2, ::2]  # the blurred image has no finer detail
        inside = _mask_in(patch, window)[every_second]
        right, down = (
            cv2.Sobel(smooth, cv2.CV_32F, *axis, scale=0.125)[every_second][inside] for axis in ((1, 0), (0, 1))
        )
        change = np.concatenate([right, -down], axis=1)
        return np.asarray(change.T @ change, np.float64)

    def read(self, image: NDArray[np.uint8], patch: Patch) -> TextureMap:
        """Return the texture map in and around a patch. image: (320, 240, 3) uint8 BGR."""
        window = ImageWindow.around(patch)
        return self._curvature(window, *self._slopes(image, window))

    def _curvature(self, window: ImageWindow, right: Field, up: Field) -> TextureMap:
        return TextureMap(window, _filtered(right, _SLOPE, _LEVEL) - _filtered(up, _LEVEL, _SLOPE), self._noise)

    def _slopes(self, image: NDArray[np.uint8], window: ImageWindow) -> Field:
        """Return slopes to the right and upwards, (2, h, w), without blur."""
        colors = self._colors_in(image, window)
        return (self._colors @ colors.reshape(-1, 3).T).reshape(2, *colors.shape[:2])

    def _colors_in(self, image: NDArray[np.uint8], window: ImageWindow) -> Field:
        """Return frame minus background image in a window, (h, w, 3) float32 gray levels."""
        left, top, right, bottom = window.left_px, window.top_px, window.right_px, window.bottom_px
        crop = image[REDUCTION * top : REDUCTION * bottom, REDUCTION * left : REDUCTION * right]
        now = cv2.resize(crop, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.subtract(now, self._background[top:bottom, left:right], dtype=cv2.CV_32F), np.float32)


def _without_curl(steep: NDArray[np.float64], nominal: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the mix nearest `nominal` with little curl in the slopes: ridge regression of its six numbers."""
    swapped = [3, 4, 5, 0, 1, 2]
    sign = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])  # d/dx of the slope upwards minus d/dy of that to the right
    curl = steep[np.ix_(swapped, swapped)] * np.outer(sign, sign)
    energy = float(np.trace(curl)) / 6.0
    mix = nominal.astype(np.float64).ravel()
    change = np.linalg.solve(curl + (NOMINAL_WEIGHT * energy + 1e-6) * np.eye(6), -curl @ mix)
    return np.asarray((mix + change).reshape(2, 3), np.float32)


def _to_slopes(off_rad: float, mirrored: bool) -> NDArray[np.float32]:
    """Return (2, 3): gray levels B, G, R to slopes, for lights off by `off_rad`; mirrored: in the other sense."""
    azimuth = np.radians(np.asarray(LIGHTS_DEG))
    x, y = np.cos(azimuth), np.sin(azimuth) * (-1.0 if mirrored else 1.0)
    c, s = math.cos(off_rad), math.sin(off_rad)
    return np.asarray(np.stack([c * x + s * y, c * y - s * x]) * (2.0 / 3.0), np.float32)


def _mask_in(patch: Patch, window: ImageWindow) -> NDArray[np.bool_]:
    """Return the patch's mask and two pixels around it, in a window of the texture map."""
    return np.asarray(cv2.dilate(mask_in_window(patch, window), np.ones((5, 5), np.uint8)) > 0, np.bool_)


def mask_in_window(patch: Patch, window: ImageWindow) -> NDArray[np.uint8]:
    """Return a patch's mask in a window of the texture map, (h, w) uint8, 0 or 1."""
    scale = patch.frame_px / REDUCTION
    rows, columns = patch.mask.shape
    size = (max(round(columns * scale), 1), max(round(rows * scale), 1))
    mask = cv2.resize(patch.mask, size, interpolation=cv2.INTER_NEAREST)
    out = np.zeros((window.bottom_px - window.top_px, window.right_px - window.left_px), np.uint8)
    x, y = round(patch.left_px * scale) - window.left_px, round(patch.top_px * scale) - window.top_px
    part = out[y : y + size[1], x : x + size[0]]
    part[:] = mask[: part.shape[0], : part.shape[1]]
    return out


def _filtered(image: Field, across: Field, down: Field) -> Field:
    """Filter an image, (h, w) or (h, w, n), with one kernel along its rows and one along its columns."""
    return np.asarray(cv2.sepFilter2D(image, cv2.CV_32F, across, down), np.float32)


def _half_size(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), np.uint8)
