"""A folder of images and masks, in any of the usual layouts, converted to a data set for training."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slipguard.datasets.dataset_files import (
    BACKGROUNDS,
    IMAGES,
    IMPORTED_LABEL,
    MANIFEST_NAME,
    MASKS,
    DataSetWriter,
    Image,
    check_new,
    png,
)
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.tools.image_decoding import decode_file
from slipguard.tools.image_files import IMAGE_ENDINGS, read_image
from slipguard.tools.parallel import Workers, each

_MASK_WORDS = r"masks?|labels?|gt|seg|segmentation|ground_?truth|annotations?|targets?|segmentationclass"
_MASK_FOLDER = re.compile(_MASK_WORDS, re.IGNORECASE)
_MASK_ENDING = re.compile(rf"(?<=.)[_.-]({_MASK_WORDS})$")
_IMAGE_FOLDER = re.compile(r"images?|imgs?|frames?|rgb|inputs?|jpegimages", re.IGNORECASE)
SHAPE_TOLERANCE = 0.02
"""Tolerance of the 3:4 side ratio before an image counts as stretched."""
_SIZE = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """An image and its mask. name: the image's path relative to the folder."""

    name: str
    image: Path
    mask: Path


@dataclass(frozen=True, slots=True)
class ImportResult:
    """The result. rotated: landscape images; stretched: of another side ratio than 3:4; left_out: name and reason."""

    frames: int
    rotated: int
    stretched: int
    left_out: tuple[str, ...]


def found_pairs(source: Path) -> tuple[list[ImagePair], list[str]]:
    """Return the pairs in a folder, by name, and a message for each image or mask without a partner.

    Two layouts are supported, also nested (train/, val/): an image folder and a mask folder (masks, labels, gt, ...)
    with the same file stems, where a mask may add such a word (a.png, a_mask.png); or image and mask in one folder,
    distinguished by such an ending. Raises InputError for a missing folder or one without a pair.
    """
    if not source.is_dir():
        raise InputError(f"{source}: not a folder; name one with images and masks")
    if all((source / name).exists() for name in (MANIFEST_NAME, IMAGES, BACKGROUNDS, MASKS)):
        raise InputError(f"{source}: already a data set of slipguard; no import is needed")
    files = sorted(path for path in source.rglob("*") if path.suffix.lower() in IMAGE_ENDINGS and path.is_file())
    images: dict[tuple[str, ...], Path] = {}
    masks: dict[tuple[str, ...], Path] = {}
    for path in files:
        key, is_mask = _key(source, path)
        side = masks if is_mask else images
        if key in side:
            raise InputError(f"{path} and {side[key]} have the same name; keep one of them")
        side[key] = path
    pairs = [
        ImagePair(_named(source, images[key]), images[key], masks[key]) for key in sorted(images.keys() & masks.keys())
    ]
    if not pairs:
        raise InputError(
            f"{source}: {len(images)} images and {len(masks)} masks, but no pair; supported are images/ and masks/ "
            "with the same file names, or NAME.png with NAME_mask.png"
        )
    unpaired = [f"{_named(source, images[key])}: no mask" for key in sorted(images.keys() - masks.keys())]
    unpaired += [f"{_named(source, masks[key])}: no image" for key in sorted(masks.keys() - images.keys())]
    return pairs, unpaired


def import_dataset(
    source: Path,
    out_dir: Path,
    background: Image | None = None,
    skip: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workers: Workers | None = None,
) -> ImportResult:
    """Write the pairs in `source` as a data set into a new or empty folder.

    Images become 240 wide x 320 high: scaled, rotated upright like in digit-interface if they are landscape, and
    stretched if their side ratio differs. Masks may be 0 and 1 or 0 and 255, gray or of one color, and of another size
    than their image if the ratio is the same.

    Args:
        background: background image (320, 240, 3) of all images.
        skip: leave out unpaired and unreadable files; otherwise the first one raises InputError.
        progress: called with the number done and the total.
    """
    check_new(out_dir)
    pairs, left_out = found_pairs(source)
    if left_out and not skip:
        unpaired = f"{len(left_out)} unpaired file{'s' * (len(left_out) != 1)}"
        complete = f"{len(pairs)} complete pair{'s' * (len(pairs) != 1)}"
        raise InputError(f"{source}: {left_out[0]} ({unpaired}, {complete}); add the missing files or use --skip")
    rotated = stretched = 0
    under = None if background is None else png(background)
    progress(0, len(pairs))
    with DataSetWriter(out_dir) as writer:
        for done, (pair, result) in enumerate(zip(pairs, each(_convert, pairs, workers), strict=True), 1):
            progress(done, len(pairs))
            if isinstance(result, str):
                if not skip:
                    raise InputError(f"{result.rstrip('.')}. Use --skip to leave such files out.")
                left_out.append(result)
                continue
            image, mask, is_rotated, is_stretched = result
            line = {"source": pair.name, "split": "imported", "label": IMPORTED_LABEL}
            writer.add(line, mask, {IMAGES: image} if under is None else {IMAGES: image, BACKGROUNDS: under})
            rotated += is_rotated
            stretched += is_stretched
    if writer.written == 0:
        raise InputError(f"{source}: none of {len(pairs)} pairs is usable; the first: {left_out[0]}")
    return ImportResult(writer.written, rotated, stretched, tuple(left_out))


_Converted = tuple[bytes, Image, bool, bool]
"""The image as PNG, the mask (0 or 1), whether the image was rotated, and whether it was stretched."""


def _convert(pair: ImagePair) -> _Converted | str:
    try:
        return _frame(pair)
    except (InputError, OSError) as error:
        return str(error)


def _frame(pair: ImagePair) -> _Converted:
    image, mask = read_image(pair.image), _read_mask(pair.mask)
    if abs(mask.shape[0] * image.shape[1] / (mask.shape[1] * image.shape[0]) - 1.0) > SHAPE_TOLERANCE:
        sizes = f"{mask.shape[1]}x{mask.shape[0]}, its image {image.shape[1]}x{image.shape[0]}"
        raise InputError(f"{pair.mask}: {sizes}; a mask must have the side ratio of its image")
    landscape = image.shape[1] > image.shape[0]
    if landscape:
        image, mask = (np.ascontiguousarray(np.rot90(array)) for array in (image, mask))
    stretch = image.shape[1] * FRAME_HEIGHT_PX / (image.shape[0] * FRAME_WIDTH_PX)
    method = cv2.INTER_AREA if image.shape[0] >= FRAME_HEIGHT_PX else cv2.INTER_LINEAR
    fitted = np.asarray(cv2.resize(image, _SIZE, interpolation=method), np.uint8)
    contact = cv2.resize(mask * np.uint8(255), _SIZE, interpolation=cv2.INTER_LINEAR) > 127
    return png(fitted), contact.astype(np.uint8), landscape, abs(stretch - 1.0) > SHAPE_TOLERANCE


def _read_mask(path: Path) -> Image:
    """Return a mask, (H, W) uint8, 0 or 1."""
    values = decode_file(path, cv2.IMREAD_UNCHANGED)
    gray = values if values.ndim == 2 else values[..., :3].max(2)
    if gray.dtype != np.uint8:
        gray = (gray // 257).astype(np.uint8) if gray.max() > 255 else gray.astype(np.uint8)
    if gray.max() <= 1:
        return np.asarray(gray, np.uint8)
    between = float(np.mean((gray > 32) & (gray < 223)))
    if between > SHAPE_TOLERANCE:
        values_found = ", ".join(str(value) for value in np.unique(gray)[:6])
        raise InputError(f"{path}: values {values_found} ...; a mask has 0 and 1, or 0 and 255")
    return np.asarray(gray > 127, np.uint8)


def _key(source: Path, path: Path) -> tuple[tuple[str, ...], bool]:
    """Return the key shared by image and mask, and whether the file is a mask."""
    *folders, _ = path.relative_to(source).parts
    stem = path.stem.lower()
    plain = _MASK_ENDING.sub("", stem)
    is_mask = plain != stem or any(_MASK_FOLDER.fullmatch(folder) for folder in folders)
    sides = (_MASK_FOLDER, _IMAGE_FOLDER)
    common = [folder for folder in folders if not any(side.fullmatch(folder) for side in sides)]
    return (*common, plain), is_mask


def _named(source: Path, path: Path) -> str:
    return str(path.relative_to(source))
