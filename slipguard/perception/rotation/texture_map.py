"""The gel's relief, as far as its colours tell it: how strongly the surface is curved, place by place.

Each of the three lights brightens what slopes towards it, so that colours tell slopes; the divergence of the slopes
is a property of the object's surface and turns with the object, while the lights stay where they are.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.perception.contact.patch import Patch

REDUCTION = 2
"""Frame pixels per pixel of the relief: what is finer lies below the gel's and the camera's own blur."""
WIDTH_PX, HEIGHT_PX = FRAME_WIDTH_PX // REDUCTION, FRAME_HEIGHT_PX // REDUCTION
AROUND_PX = 12
"""The relief is read this far around the patch's box: the slopes around a contact, and room for filters."""
LIGHTS_DEG = (270.0, 150.0, 30.0)
"""Azimuths of the blue, green and red light of a DIGIT, counter-clockwise from the picture's right."""
MIRRORED_MARGIN = 0.1
"""Lights are taken in the other sense of rotation only where that makes the slopes a surface's by this much more."""
BLUR_PX = 1.0
NOMINAL_WEIGHT = 1.0
"""How strongly the learnt mix of colours is held to that of three equal lights, as a share of the relief's energy."""
NOISE_SHARE = 0.175
"""Noise of the curvature over noise of a pixel, for colours that tell slopes one to one: measured on frames of nothing
but noise whose neighbouring pixels have the sensor's correlation of 0.65; white noise leaves less."""

Field = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ImageWindow:
    """A part of the relief's picture of 120 x 160: its first column and row, and those after its last."""

    left_px: int
    top_px: int
    right_px: int
    bottom_px: int

    @classmethod
    def around(cls, patch: Patch) -> ImageWindow:
        """The window of a patch's crop and what lies around it."""
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
    """Curvature in one window: (h, w) float32, grey levels a pixel.

    noise: what the camera's noise makes of an untouched gel, one standard deviation; 0 where it is not known.
    """

    window: ImageWindow
    curvature: Field
    noise: float = 0.0


class TextureMapReader:
    """Reads the relief of one finger's frames. Pure but for the mix of colours, which `learn` finds at the reference.

    background: the unit's no-contact image, (320, 240, 3) uint8 BGR. noise_bgr: standard deviation of a pixel, grey
    levels; None where it is not known.
    """

    def __init__(
        self, background: NDArray[np.uint8], noise_bgr: Sequence[float] | NDArray[np.floating] | None = None
    ) -> None:
        self._background: NDArray[np.uint8] = _halved(background)
        self._noise_bgr = np.zeros(3) if noise_bgr is None else np.asarray(noise_bgr, np.float64)
        self._take(_to_slopes(0.0, mirrored=False))

    def _take(self, colours: NDArray[np.float32]) -> None:
        self._colours = colours
        self._noise = NOISE_SHARE * float(np.linalg.norm(colours * self._noise_bgr))

    def learn(self, image: NDArray[np.uint8], patch: Patch) -> None:
        """Find the mix of colours that tells slopes, from a frame with contact.

        First the lights' sense and common turn: with slopes s = sx + i sy told by lights in the right sense,
        (d/dx - i d/dy) s is real wherever the gel is a surface, but for one factor by which all azimuths are off; in
        the wrong sense its phase varies. Then strengths and cross-talk: slopes of a surface have no curl.
        """
        steep = self._steepness(image, ImageWindow.around(patch), patch)
        found = []
        for mirrored in (False, True):
            x, y = _to_slopes(0.0, mirrored).astype(np.float64)
            along, across = np.concatenate([x, y]), np.concatenate([y, -x])  # of d/dx and d/dy of every colour
            re2, im2 = float(along @ steep @ along), float(across @ steep @ across)
            square = complex(re2 - im2, 2.0 * float(along @ steep @ across))
            found.append((abs(square) / max(re2 + im2, 1e-9), math.atan2(square.imag, square.real) / 2))
        mirrored = found[1][0] > found[0][0] + MIRRORED_MARGIN
        self._take(_without_curl(steep, _to_slopes(found[int(mirrored)][1], mirrored)))

    def _steepness(self, image: NDArray[np.uint8], window: ImageWindow, patch: Patch) -> NDArray[np.float64]:
        """(6, 6): products of the three colours' change to the right and upwards, summed over the patch."""
        level = np.asarray(cv2.GaussianBlur(self._difference(image, window), (0, 0), BLUR_PX), np.float32)
        mask = _mask_in(patch, window)
        change = np.concatenate([_dx(level)[mask], _dy(level)[mask]], axis=1).astype(np.float64)
        return np.asarray(change.T @ change)

    def read(self, image: NDArray[np.uint8], patch: Patch) -> TextureMap:
        """The relief in and around a patch. image: (320, 240, 3) uint8 BGR."""
        window = ImageWindow.around(patch)
        slopes = cv2.GaussianBlur(cv2.transform(self._difference(image, window), self._colours), (0, 0), BLUR_PX)
        right, up = cv2.split(slopes)
        return TextureMap(window, _dx(np.asarray(right, np.float32)) + _dy(np.asarray(up, np.float32)), self._noise)

    def _difference(self, image: NDArray[np.uint8], window: ImageWindow) -> Field:
        """Picture less no-contact image in a window, (h, w, 3) float32 grey levels."""
        left, top, right, bottom = window.left_px, window.top_px, window.right_px, window.bottom_px
        crop = image[REDUCTION * top : REDUCTION * bottom, REDUCTION * left : REDUCTION * right]
        now = cv2.resize(crop, (right - left, bottom - top), interpolation=cv2.INTER_AREA)
        return np.asarray(cv2.subtract(now, self._background[top:bottom, left:right], dtype=cv2.CV_32F), np.float32)


def _without_curl(steep: NDArray[np.float64], nominal: NDArray[np.float32]) -> NDArray[np.float32]:
    """The mix nearest `nominal` that leaves little curl in the slopes: ridge regression of its six numbers."""
    swapped = [3, 4, 5, 0, 1, 2]
    sign = np.array([-1.0, -1.0, -1.0, 1.0, 1.0, 1.0])  # curl: d/dx of the slope upwards less d/dy of that to the right
    told = steep[np.ix_(swapped, swapped)] * np.outer(sign, sign)
    energy = float(np.trace(told)) / 6.0
    mix = nominal.astype(np.float64).ravel()
    change = np.linalg.solve(told + (NOMINAL_WEIGHT * energy + 1e-6) * np.eye(6), -told @ mix)
    return np.asarray((mix + change).reshape(2, 3), np.float32)


def _to_slopes(off_rad: float, mirrored: bool) -> NDArray[np.float32]:
    """(2, 3): grey levels B, G, R to slopes, for lights `off_rad` from their places; mirrored: in the other sense."""
    azimuth = np.radians(np.asarray(LIGHTS_DEG))
    x, y = np.cos(azimuth), np.sin(azimuth) * (-1.0 if mirrored else 1.0)
    c, s = math.cos(off_rad), math.sin(off_rad)
    return np.asarray(np.stack([c * x + s * y, c * y - s * x]) * (2.0 / 3.0), np.float32)


def _mask_in(patch: Patch, window: ImageWindow) -> NDArray[np.bool_]:
    """The patch's mask and two pixels around it, in a window of the relief."""
    return np.asarray(cv2.dilate(placed(patch, window), np.ones((5, 5), np.uint8)) > 0, np.bool_)


def placed(patch: Patch, window: ImageWindow) -> NDArray[np.uint8]:
    """A patch's mask in a window of the relief, (h, w) uint8, 0 or 1."""
    scale = patch.frame_px / REDUCTION
    rows, columns = patch.mask.shape
    size = (max(round(columns * scale), 1), max(round(rows * scale), 1))
    mask = cv2.resize(patch.mask, size, interpolation=cv2.INTER_NEAREST)
    out = np.zeros((window.bottom_px - window.top_px, window.right_px - window.left_px), np.uint8)
    x, y = round(patch.left_px * scale) - window.left_px, round(patch.top_px * scale) - window.top_px
    part = out[y : y + size[1], x : x + size[0]]
    part[:] = mask[: part.shape[0], : part.shape[1]]
    return out


def _dx(field: Field) -> Field:
    return np.asarray(cv2.Sobel(field, cv2.CV_32F, 1, 0, scale=0.125), np.float32)


def _dy(field: Field) -> Field:
    """Upwards."""
    return np.asarray(cv2.Sobel(field, cv2.CV_32F, 0, 1, scale=-0.125), np.float32)


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    return np.asarray(cv2.resize(image, (WIDTH_PX, HEIGHT_PX), interpolation=cv2.INTER_AREA), np.uint8)
