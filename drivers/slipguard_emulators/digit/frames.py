"""The images of an emulated DIGIT in its wire format: rendered, or read from a folder."""

from __future__ import annotations

from functools import cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit

Image = NDArray[np.uint8]
IMAGES = 48
"""Rendered once and sent in turn; no image equals the previous one."""
CONTACT = range(16, 44)
"""Images with contact: the object is pressed in, rotates by ROTATION_DEG, and is removed."""
ROTATION_DEG = 12.0
DEPTH_MM = 0.5
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp"})
JPEG_QUALITY = 90


@cache
def rendered_images(seed: int, object_name: str) -> tuple[Image, ...]:
    """Return images of a press with rotation, (320, 240, 3) uint8 BGR. Raises InputError for an unknown object."""
    camera = GelCamera(random_unit(np.random.default_rng(seed)), seed=seed)
    images = []
    for number in range(IMAGES):
        view = GelView(object_name)
        if number in CONTACT:
            share = (number - CONTACT.start) / len(CONTACT)
            pressed = min(1.0, 6.0 * share, 6.0 * (1.0 - share))
            view = GelView(object_name, angle_deg=30.0 + ROTATION_DEG * share, depth_mm=DEPTH_MM * max(pressed, 0.05))
        images.append(camera.draw(view))
    return tuple(images)


def read(folder: Path) -> list[Image]:
    """Return the images of a folder by name. Raises InputError if it has none, or one of another size."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; name one with images of 240 wide x 320 high")
    images = []
    for path in sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None or image.shape[:2] != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX):
            seen = "cannot be read" if image is None else f"is {image.shape[1]} wide x {image.shape[0]} high"
            raise InputError(f"{path} {seen}; the sensor's images are 240 wide x 320 high")
        images.append(np.asarray(image, np.uint8))
    if not images:
        raise InputError(f"{folder} has no image ({', '.join(sorted(IMAGE_SUFFIXES))})")
    return images


def torn_image(first: Image, second: Image, share: float) -> Image:
    """Return an image with this share of its rows on the wire from the first image, the others from the second.

    Rows on the wire are columns of the portrait image, the top row is the left column.
    """
    rows = min(max(round(share * FRAME_WIDTH_PX), 1), FRAME_WIDTH_PX - 1)
    image = second.copy()
    image[:, :rows] = first[:, :rows]
    return image


def encode_image(image: Image, pixels: str, width_px: int, height_px: int) -> bytes:
    """Return a portrait image as the sensor sends it: landscape, in the negotiated size and format."""
    landscape = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
    if landscape.shape[:2] != (height_px, width_px):
        landscape = cv2.resize(landscape, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
    if pixels == "YUYV":
        return bytes(cv2.cvtColor(landscape, cv2.COLOR_BGR2YUV_YUYV).tobytes())
    return bytes(cv2.imencode(".jpg", landscape, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
