"""Augmentation of rendered frames to the variety of real units: light, drift, wear, unknown backgrounds."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from slipguard.datasets.background_patterns import drift, patterns, resized, structure
from slipguard.perception.background import estimate_background
from slipguard.perception.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX

STRUCTURE_LEVELS = 28.0
DRIFT_LEVELS = 16.0
LIGHT_LEVELS = (5.0, 2.5, 2.5, 1.5, 1.5, 1.5)
"""Largest drift of the lamps in gray levels: constant, x, y, xy, x^2, y^2."""
BACKGROUND_NOISE_LEVELS = 1.2
"""Camera noise in a background image of a single frame, at network resolution."""
NOISE_POOL = 64
REAL_SHARE = 0.5
ZOOM_MAX = 2.2


@dataclass(frozen=True, slots=True)
class TrainingBatch:
    """Input and target. frame, background: (N, 160, 120, 3) uint8; known: (N,); label: (N, 1, 160, 120)."""

    frame: Tensor
    background: Tensor
    known: Tensor
    label: Tensor


class Augment:
    """Applies random changes that leave the label valid.

    These are contrast of the imprint, gain and offset per channel, structure of the unit in both images (slightly
    shifted in the frame), drift of many kinds in the frame, noise in the background image, and mirroring.

    Args:
        seed: Seed of all random numbers.
        pool: Number of structure and drift patterns.
        unknown: Share of samples whose background image is replaced by an estimate from the frame.
        contrast_max: Strongest imprint, relative to the rendered one.
        backgrounds: Real background images (320, 240, 3) that half of the imprints are put on.
        zoom_share: Share of samples that are enlarged.
        size: (width, height) of the network's input.
    """

    def __init__(
        self,
        seed: int,
        pool: int = 800,
        unknown: float = 0.25,
        contrast_max: float = 1.5,
        backgrounds: list[NDArray[np.uint8]] | None = None,
        zoom_share: float = 0.0,
        size: tuple[int, int] = (INPUT_WIDTH_PX, INPUT_HEIGHT_PX),
    ) -> None:
        self._rng = torch.Generator().manual_seed(seed)
        self._structure = torch.from_numpy(resized(patterns(structure, pool, seed), size))
        self._drift = torch.from_numpy(resized(patterns(drift, pool, seed + 1), size))
        width, height = self._size = size
        noise = torch.randn((NOISE_POOL, height, width, 3), generator=self._rng)
        self._noise = noise.half()
        self._unknown = unknown
        self._contrast_max = contrast_max
        self._zoom_share = zoom_share
        self._backgrounds = [cv2.resize(image, size, interpolation=cv2.INTER_AREA) for image in backgrounds or []]
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        third = torch.full_like(x, 1.0 / 3.0)
        self._light = torch.stack([torch.ones_like(x), x, y, x * y, x * x - third, y * y - third])

    def __call__(self, frame: Tensor, background: Tensor, label: Tensor) -> TrainingBatch:
        """Return an augmented batch. frame, background: (N, 160, 120, 3) uint8; label: (N, 160, 120), 255: contact."""
        count = len(frame)
        if self._zoom_share:
            frame, background, label = self._zoom(frame, background, label)
        unit = background.float()
        change = (frame.float() - unit) * self._between(count, 0.6, self._contrast_max)
        unit = self._put_on_real(unit)
        image = unit + change
        image, unit = self._add_structure(image, unit)
        gain = self._between(count, 0.8, 1.25) * self._between(count, 0.85, 1.15, channels=3)
        offset = self._between(count, -12.0, 12.0)
        image = self._add_drift(image * gain + offset)
        unit = unit * gain + offset
        unit = unit + self._pick(self._noise, count) * (self._flags(count, 0.5) * BACKGROUND_NOISE_LEVELS)
        axes = [axis for axis in (1, 2) if self._coin(0.5)]
        image, unit, label = image.flip(axes), unit.flip(axes), label.flip(axes)
        shown = image.round().clamp(0, 255).byte()
        reference = unit.round().clamp(0, 255).byte()
        known = (torch.rand(count, generator=self._rng) >= self._unknown).float()
        for index in torch.nonzero(known == 0).flatten().tolist():
            reference[index] = torch.from_numpy(estimate_background(shown[index].numpy()))
        return TrainingBatch(shown, reference, known, label[:, None].float() / 255.0)

    def _zoom(self, frame: Tensor, background: Tensor, label: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Enlarge a share of the samples by up to `ZOOM_MAX` around a point of the imprint: broad, smooth bulges."""
        images = [frame.numpy().copy(), background.numpy().copy(), label.numpy().copy()]
        for index in torch.nonzero(torch.rand(len(frame), generator=self._rng) < self._zoom_share).flatten().tolist():
            rows, columns = np.nonzero(images[2][index])
            if len(rows) == 0:
                continue
            zoom, which = torch.rand(2, generator=self._rng).tolist()
            at = int(which * len(rows))
            about = ((columns[at] + columns.mean()) / 2.0, (rows[at] + rows.mean()) / 2.0)
            matrix = cv2.getRotationMatrix2D(about, 0.0, 1.0 + (ZOOM_MAX - 1.0) * zoom)
            for image in images:
                image[index] = cv2.warpAffine(image[index], matrix, self._size, borderMode=cv2.BORDER_REPLICATE)
        return torch.from_numpy(images[0]), torch.from_numpy(images[1]), torch.from_numpy(images[2])

    def _put_on_real(self, unit: Tensor) -> Tensor:
        """Replace half of the backgrounds by a warped real image, or a mix of two."""
        if not self._backgrounds:
            return unit
        out = unit.clone()
        for index in torch.nonzero(torch.rand(len(unit), generator=self._rng) < REAL_SHARE).flatten().tolist():
            weight = 1.0 if self._coin(0.5) else float(torch.rand((), generator=self._rng))
            out[index] = weight * self._warp_real() + (1.0 - weight) * self._warp_real()
        return out

    def _warp_real(self) -> Tensor:
        """Return a real background image rotated by up to 15 degrees, enlarged, shifted and sometimes mirrored."""
        which, rotation, scale, right, down, mirror = torch.rand(6, generator=self._rng).tolist()
        image = self._backgrounds[int(which * len(self._backgrounds))]
        center = (self._size[0] / 2, self._size[1] / 2)
        matrix = cv2.getRotationMatrix2D(center, 30.0 * rotation - 15.0, 1.0 + 0.4 * scale)
        matrix[:, 2] += (20.0 * right - 10.0, 20.0 * down - 10.0)
        warped = cv2.warpAffine(image, matrix, self._size, borderMode=cv2.BORDER_REFLECT)
        return torch.from_numpy(warped[:, ::-1].copy() if mirror < 0.3 else warped).float()

    def _add_structure(self, image: Tensor, unit: Tensor) -> tuple[Tensor, Tensor]:
        count = len(image)
        strength = self._flags(count, 0.7) * self._between(count, 0.0, 1.0) ** 1.5 * STRUCTURE_LEVELS
        here = self._pick(self._structure, count) * strength
        moved = here
        if self._coin(0.5):
            down, right = torch.randint(-3, 4, (2,), generator=self._rng).tolist()
            moved = torch.roll(here, (down, right), (1, 2))
        return image + moved, unit + here

    def _add_drift(self, image: Tensor) -> Tensor:
        count = len(image)
        strength = self._flags(count, 0.75) * self._between(count, 0.0, 1.0) ** 1.5 * DRIFT_LEVELS
        image = image + self._pick(self._drift, count) * strength
        image = image * (1.0 + self._between(count, -0.06, 0.06, channels=3) * self._flags(count, 0.7))
        terms = (2.0 * torch.rand((count, 3, 6), generator=self._rng) - 1.0) * torch.tensor(LIGHT_LEVELS)
        light = torch.einsum("nct,thw->nhwc", terms, self._light)
        return image + light * self._flags(count, 0.85)

    def _pick(self, pool: Tensor, count: int) -> Tensor:
        which = torch.randint(len(pool), (count,), generator=self._rng)
        axes = [axis for axis in (1, 2) if self._coin(0.5)]
        return pool[which].float().flip(axes)

    def _between(self, count: int, low: float, high: float, channels: int = 1) -> Tensor:
        return low + (high - low) * torch.rand((count, 1, 1, channels), generator=self._rng)

    def _flags(self, count: int, share: float) -> Tensor:
        return (torch.rand((count, 1, 1, 1), generator=self._rng) < share).float()

    def _coin(self, share: float) -> bool:
        return bool(torch.rand((), generator=self._rng) < share)
