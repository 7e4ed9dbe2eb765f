"""A data set to look at: one picture of evenly chosen frames with their labels laid over them."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from slipguard.datasets.files import BACKGROUNDS, Image, data_set_pairs, png, read_colour
from slipguard.errors import InputError

COLUMNS, ROWS = 10, 3
TILE_PX = (120, 160)
_TINT_BGR = (0, 200, 255)


def contact_sheet(folder: Path, target: Path) -> None:
    """Write the picture: up to 30 frames, each as it is, with its label tinted and outlined below.

    Where the no-contact image is known, the difference to it is the third in each column. Raises InputError where
    `folder` has no data set or `target` cannot be written.
    """
    pairs = data_set_pairs(folder)
    count = min(len(pairs), COLUMNS * ROWS)
    tiles = [_tile(folder, *pairs[k * len(pairs) // count]) for k in range(count)]
    columns = min(COLUMNS, count)
    tiles += [np.zeros_like(tiles[0])] * (-count % columns)
    rows = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
    try:
        target.write_bytes(png(np.asarray(np.vstack(rows), np.uint8)))
    except OSError as error:
        raise InputError(f"{target} cannot be written: {error.strerror or error}; name another place") from error


def _tile(folder: Path, image_path: Path, mask_path: Path) -> Image:
    image = cv2.resize(read_colour(image_path), TILE_PX, interpolation=cv2.INTER_AREA)
    mask = np.asarray(cv2.resize(read_colour(mask_path)[..., 0], TILE_PX, interpolation=cv2.INTER_AREA) > 127)
    labelled = image.copy()
    labelled[mask] = (labelled[mask] * 0.65 + np.asarray(_TINT_BGR) * 0.35).astype(np.uint8)
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(labelled, outlines, -1, (255, 255, 255), 1)
    parts = [image, labelled]
    background = folder / BACKGROUNDS / image_path.name
    if (folder / BACKGROUNDS).is_dir():
        under = cv2.resize(read_colour(background), TILE_PX, interpolation=cv2.INTER_AREA)
        parts.append(np.clip(image.astype(np.int16) - under + 128, 0, 255).astype(np.uint8))
    tile = np.vstack(parts)
    tile[:, -1] = tile[-1] = 0
    return np.asarray(tile, np.uint8)
