"""Somebody's folder of images and masks, whatever its layout, as a data set that training reads."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from slipguard.datasets.files import (
    BACKGROUNDS,
    IMAGES,
    MANIFEST_NAME,
    MASKS,
    DataSetWriter,
    Files,
    Image,
    check_new,
    png,
)
from slipguard.errors import InputError
from slipguard.sim.sensor_unit import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.tools.image_files import IMAGE_ENDINGS, damage, read_image
from slipguard.tools.parallel import Workers, each

_MASK_WORDS = r"masks?|labels?|gt|seg|segmentation|ground_?truth|annotations?|targets?|segmentationclass"
_MASK_FOLDER = re.compile(_MASK_WORDS, re.IGNORECASE)
_MASK_ENDING = re.compile(rf"(?<=.)[_.-]({_MASK_WORDS})$")
_IMAGE_FOLDER = re.compile(r"images?|imgs?|frames?|rgb|inputs?|jpegimages", re.IGNORECASE)
LABEL_NAME = "imported"
SHAPE_TOLERANCE = 0.02
"""Sides may be off 3 to 4 by this share before a picture counts as stretched."""
_SIZE = (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)


@dataclass(frozen=True, slots=True)
class ImagePair:
    """An image and its mask. name: to tell them by, the image's path below the folder."""

    name: str
    image: Path
    mask: Path


@dataclass(frozen=True, slots=True)
class ImportResult:
    """What came of it. turned: lay on their side; stretched: of another shape than 3 to 4; left_out: why, per name."""

    frames: int
    rotated: int
    stretched: int
    left_out: tuple[str, ...]


def found_pairs(source: Path) -> tuple[list[ImagePair], list[str]]:
    """The pairs under a folder, by name, and a complaint for each image or mask that has no partner.

    Two layouts, also nested (train/, val/): folders side by side of which one is named masks, labels, gt or the like,
    with one stem on both sides (a mask may add such a word: a.png, a_mask.png); or image and mask in one folder, told
    apart by such an ending of the mask. Raises InputError for a folder that is missing or without a pair.
    """
    if not source.is_dir():
        raise InputError(f"{source} is not a folder; name one with images and masks")
    if all((source / name).exists() for name in (MANIFEST_NAME, IMAGES, BACKGROUNDS, MASKS)):
        raise InputError(f"{source} is a data set of slipguard already, and needs no import")
    files = sorted(path for path in source.rglob("*") if path.suffix.lower() in IMAGE_ENDINGS and path.is_file())
    images: dict[tuple[str, ...], Path] = {}
    masks: dict[tuple[str, ...], Path] = {}
    for path in files:
        key, is_mask = _key(source, path)
        side = masks if is_mask else images
        if key in side:
            raise InputError(f"{path} and {side[key]} would be one frame; keep one of them")
        side[key] = path
    pairs = [
        ImagePair(_named(source, images[key]), images[key], masks[key]) for key in sorted(images.keys() & masks.keys())
    ]
    if not pairs:
        raise InputError(
            f"{source}: {len(images)} images and {len(masks)} masks, no two of one name; wanted are images/ and masks/ "
            "with the same file names, or NAME.png with NAME_mask.png"
        )
    alone = [f"{_named(source, images[key])}: no mask" for key in sorted(images.keys() - masks.keys())]
    alone += [f"{_named(source, masks[key])}: no image" for key in sorted(masks.keys() - images.keys())]
    return pairs, alone


def import_dataset(
    source: Path,
    out_dir: Path,
    background: Image | None = None,
    skip: bool = False,
    progress: Callable[[int, int], None] = lambda done, total: None,
    workers: Workers | None = None,
) -> ImportResult:
    """Write the pairs under `source` as a data set into a new or empty folder.

    Pictures become 240 wide x 320 high: shrunk or enlarged, turned upright as digit-interface does where they lie on
    their side, stretched where they have another shape. Masks may be 0 and 1 or 0 and 255, grey or in one colour, and
    of another size than their image if of its shape. background: the no-contact image (320, 240, 3) of all. skip: leave
    out what has no partner or cannot be read; otherwise the first such file raises InputError. progress(done, total).
    """
    check_new(out_dir)
    pairs, left_out = found_pairs(source)
    if left_out and not skip:
        raise InputError(
            f"{source}: {left_out[0]} ({len(left_out)} such files, {len(pairs)} pairs); complete them, or give --skip"
        )
    rotated = stretched = 0
    under = None if background is None else png(background)
    progress(0, len(pairs))
    with DataSetWriter(out_dir) as writer:
        for done, (pair, result) in enumerate(zip(pairs, each(_read, pairs, workers), strict=True), 1):
            progress(done, len(pairs))
            if isinstance(result, str):
                if not skip:
                    raise InputError(f"{result}, or give --skip")
                left_out.append(result)
                continue
            files = result.files if under is None else result.files | {BACKGROUNDS: under}
            name = {"file": f"{writer.written:06d}.png", "source": pair.name, "split": "imported", "label": LABEL_NAME}
            writer.add(name | {"has_contact": result.share > 0.0, "contact_share": round(result.share, 5)}, files)
            rotated += result.rotated
            stretched += result.stretched
    if writer.written == 0:
        raise InputError(f"{source}: none of {len(pairs)} pairs can be used; the first: {left_out[0]}")
    return ImportResult(writer.written, rotated, stretched, tuple(left_out))


@dataclass(frozen=True, slots=True)
class _Read:
    files: Files
    share: float
    rotated: bool
    stretched: bool


def _read(pair: ImagePair) -> _Read | str:
    """What is to be written, or why it cannot be."""
    try:
        return _frame(pair)
    except (InputError, OSError) as error:
        return str(error)


def _frame(pair: ImagePair) -> _Read:
    image, mask = read_image(pair.image), _read_mask(pair.mask)
    if abs(mask.shape[0] * image.shape[1] / (mask.shape[1] * image.shape[0]) - 1.0) > SHAPE_TOLERANCE:
        seen = f"{mask.shape[1]}x{mask.shape[0]}, its image {image.shape[1]}x{image.shape[0]}"
        raise InputError(f"{pair.mask}: {seen}; a mask must have the shape of its image")
    on_its_side = image.shape[1] > image.shape[0]
    if on_its_side:
        image, mask = (np.ascontiguousarray(np.rot90(array)) for array in (image, mask))
    stretch = image.shape[1] * FRAME_HEIGHT_PX / (image.shape[0] * FRAME_WIDTH_PX)
    method = cv2.INTER_AREA if image.shape[0] >= FRAME_HEIGHT_PX else cv2.INTER_LINEAR
    fitted = np.asarray(cv2.resize(image, _SIZE, interpolation=method), np.uint8)
    contact = cv2.resize(mask * np.uint8(255), _SIZE, interpolation=cv2.INTER_LINEAR) > 127
    files = {IMAGES: png(fitted), MASKS: png(contact.astype(np.uint8) * np.uint8(255))}
    return _Read(files, float(contact.mean()), on_its_side, abs(stretch - 1.0) > SHAPE_TOLERANCE)


def _read_mask(path: Path) -> Image:
    """(H, W) uint8, 0 or 1."""
    data = path.read_bytes()
    wrong = damage(data)
    values = None if wrong else cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if values is None:
        raise InputError(f"{path}: {wrong or 'no image can be decoded from it'}; give a whole image file")
    grey = values if values.ndim == 2 else values[..., :3].max(2)
    if grey.dtype != np.uint8:
        grey = (grey // 257).astype(np.uint8) if grey.max() > 255 else grey.astype(np.uint8)
    if grey.max() <= 1:
        return np.asarray(grey, np.uint8)
    between = float(np.mean((grey > 32) & (grey < 223)))
    if between > SHAPE_TOLERANCE:
        seen = ", ".join(str(value) for value in np.unique(grey)[:6])
        raise InputError(f"{path}: values {seen} ...; a mask has 0 and 1, or 0 and 255")
    return np.asarray(grey > 127, np.uint8)


def _key(source: Path, path: Path) -> tuple[tuple[str, ...], bool]:
    """What image and mask have in common, and whether the file is a mask."""
    *folders, _ = path.relative_to(source).parts
    stem = path.stem.lower()
    plain = _MASK_ENDING.sub("", stem)
    is_mask = plain != stem or any(_MASK_FOLDER.fullmatch(folder) for folder in folders)
    sides = (_MASK_FOLDER, _IMAGE_FOLDER)
    common = [folder for folder in folders if not any(side.fullmatch(folder) for side in sides)]
    return (*common, plain), is_mask


def _named(source: Path, path: Path) -> str:
    return str(path.relative_to(source))
