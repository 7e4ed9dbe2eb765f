"""Training frames, and their augmentation to the variety of real units: light, drift, wear, unknown backgrounds."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from slipguard.datasets.background_patterns import drift, patterns, structure
from slipguard.datasets.dataset_files import Image, data_set_pairs, labeled_frames
from slipguard.datasets.samples import render_samples, unit_blocks
from slipguard.errors import InputError
from slipguard.perception.background import estimate_background
from slipguard.perception.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.contact_label import label
from slipguard.tools.parallel import Workers, each

STRUCTURE_LEVELS = 28.0
DRIFT_LEVELS = 16.0
LIGHT_LEVELS = (5.0, 2.5, 2.5, 1.5, 1.5, 1.5)
"""Largest drift of the lamps in gray levels: constant, x, y, xy, x^2, y^2."""
BACKGROUND_NOISE_LEVELS = 1.2
"""Camera noise in a background image of a single frame, at network resolution."""
NOISE_POOL = 64
CONTRAST = (0.6, 2.0)
"""Strength of the imprint, relative to the rendered one."""
UNKNOWN_SHARE = 0.3
"""Of the samples: their background image is replaced by an estimate from the frame."""
REAL_SHARE = 0.5
ZOOM_SHARE = 0.2
ZOOM_MAX = 2.2
_SIZE = (INPUT_WIDTH_PX, INPUT_HEIGHT_PX)
_Row = tuple[Image, Image, float, Image]


@dataclass(frozen=True, slots=True, eq=False)
class TrainingFrames:
    """Frames at network resolution.

    Attributes:
        frame, background: (N, 160, 120, 3) uint8 BGR.
        known: (N,) float32, 1: `background` is the unit's own, 0: it is estimated from the frame.
        label: (N, 160, 120) uint8, 255 is contact.
    """

    frame: Image
    background: Image
    known: NDArray[np.float32]
    label: Image

    def __len__(self) -> int:
        return len(self.frame)

    def part(self, which: slice | NDArray[np.int64]) -> TrainingFrames:
        return TrainingFrames(self.frame[which], self.background[which], self.known[which], self.label[which])

    @staticmethod
    def read(folder: Path) -> TrainingFrames:
        """Return the frames of a data set; missing background images are estimated. Raises InputError."""
        return _collected(len(data_set_pairs(folder)), (_row(*one) for one in labeled_frames(folder)))

    @staticmethod
    def rendered(
        first_seed: int, count: int, progress: Callable[[int], None], workers: Workers | None = None
    ) -> TrainingFrames:
        """Return the frames of `count` seeds of `render_samples` from `first_seed` on; they take 140 kB each.

        `progress` is called with the number of frames ready.
        """
        blocks = each(_rendered_rows, unit_blocks(first_seed, count), workers)
        return _collected(count, (row for rows in blocks for row in rows), progress)

    def split(self) -> tuple[TrainingFrames, TrainingFrames]:
        """Return the frames for training, and the last tenth, at least one, to hold out: neighbors stay together.

        Raises:
            InputError: There are fewer than two frames.
        """
        if len(self) < 2:
            raise InputError(f"{len(self)} frame, minimum 2: one is held out. Add frames.")
        at = len(self) - max(len(self) // 10, 1)
        return self.part(slice(at)), self.part(slice(at, None))


def _collected(count: int, rows: Iterable[_Row], progress: Callable[[int], None] = lambda done: None) -> TrainingFrames:
    size = (count, INPUT_HEIGHT_PX, INPUT_WIDTH_PX)
    frames = TrainingFrames(
        np.empty((*size, 3), np.uint8),
        np.empty((*size, 3), np.uint8),
        np.ones(count, np.float32),
        np.empty(size, np.uint8),
    )
    for index, row in enumerate(rows):
        frames.frame[index], frames.background[index], frames.known[index], frames.label[index] = row
        progress(index + 1)
    return frames


def _rendered_rows(seeds: range) -> list[_Row]:
    return [_row(one.image, one.background, label(one.truth) > 0) for one in render_samples(seeds)]


def _row(image: Image, background: Image | None, mask: NDArray[np.bool_]) -> _Row:
    frame, target = _resized(image), _resized(mask * np.uint8(255))
    shown = estimate_background(frame) if background is None else _resized(background)
    return frame, shown, float(background is not None), target


def _resized(image: Image) -> Image:
    return np.asarray(cv2.resize(image, _SIZE, interpolation=cv2.INTER_AREA), np.uint8)


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
        backgrounds: Real background images (320, 240, 3) that half of the imprints are put on.
    """

    def __init__(self, seed: int, pool: int = 800, backgrounds: list[Image] | None = None) -> None:
        self._rng = torch.Generator().manual_seed(seed)
        self._structure = torch.from_numpy(patterns(structure, pool, seed))
        self._drift = torch.from_numpy(patterns(drift, pool, seed + 1))
        width, height = _SIZE
        self._noise = torch.randn((NOISE_POOL, height, width, 3), generator=self._rng).half()
        self._backgrounds = [_resized(image) for image in backgrounds or []]
        y, x = torch.meshgrid(torch.linspace(-1, 1, height), torch.linspace(-1, 1, width), indexing="ij")
        third = torch.full_like(x, 1.0 / 3.0)
        self._light = torch.stack([torch.ones_like(x), x, y, x * y, x * x - third, y * y - third])

    def __call__(self, frames: TrainingFrames) -> TrainingBatch:
        """Return an augmented batch of all `frames`."""
        count = len(frames)
        frame, background, label = self._zoom(frames)
        unit = background.float()
        change = (frame.float() - unit) * self._between(count, *CONTRAST)
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
        known = torch.from_numpy(frames.known) * (torch.rand(count, generator=self._rng) >= UNKNOWN_SHARE)
        for index in torch.nonzero(known == 0).flatten().tolist():
            reference[index] = torch.from_numpy(estimate_background(shown[index].numpy()))
        return TrainingBatch(shown, reference, known, label[:, None].float() / 255.0)

    def _zoom(self, frames: TrainingFrames) -> tuple[Tensor, Tensor, Tensor]:
        """Enlarge a share of the samples by up to `ZOOM_MAX` around a point of the imprint: broad, smooth bulges."""
        images = [frames.frame.copy(), frames.background.copy(), frames.label.copy()]
        for index in torch.nonzero(torch.rand(len(frames), generator=self._rng) < ZOOM_SHARE).flatten().tolist():
            rows, columns = np.nonzero(images[2][index])
            if len(rows) == 0:
                continue
            zoom, which = torch.rand(2, generator=self._rng).tolist()
            at = int(which * len(rows))
            about = ((columns[at] + columns.mean()) / 2.0, (rows[at] + rows.mean()) / 2.0)
            matrix = cv2.getRotationMatrix2D(about, 0.0, 1.0 + (ZOOM_MAX - 1.0) * zoom)
            for image in images:
                image[index] = cv2.warpAffine(image[index], matrix, _SIZE, borderMode=cv2.BORDER_REPLICATE)
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
        center = (INPUT_WIDTH_PX / 2, INPUT_HEIGHT_PX / 2)
        matrix = cv2.getRotationMatrix2D(center, 30.0 * rotation - 15.0, 1.0 + 0.4 * scale)
        matrix[:, 2] += (20.0 * right - 10.0, 20.0 * down - 10.0)
        warped = cv2.warpAffine(image, matrix, _SIZE, borderMode=cv2.BORDER_REFLECT)
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
