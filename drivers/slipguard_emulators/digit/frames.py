"""What an emulated DIGIT sees, ready for its wire: drawn by the gel renderer, or read from a folder."""

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
PICTURES = 48
"""Drawn once and sent in turn: no picture equals the one before it."""
TOUCHING = range(16, 44)
"""The pictures with contact: it is pressed in, turns by TURN_DEG, and is let go."""
ROTATION_DEG = 12.0
DEPTH_MM = 0.5
IMAGE_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp"})
JPEG_QUALITY = 90


@cache
def drawn(seed: int, object_name: str) -> tuple[Image, ...]:
    """A press and a turn, (320, 240, 3) uint8 BGR each. Raises InputError for an unknown object."""
    camera = GelCamera(random_unit(np.random.default_rng(seed)), seed=seed)
    images = []
    for number in range(PICTURES):
        view = GelView(object_name)
        if number in TOUCHING:
            share = (number - TOUCHING.start) / len(TOUCHING)
            pressed = min(1.0, 6.0 * share, 6.0 * (1.0 - share))
            view = GelView(object_name, angle_deg=30.0 + ROTATION_DEG * share, depth_mm=DEPTH_MM * max(pressed, 0.05))
        images.append(camera.draw(view))
    return tuple(images)


def read(folder: Path) -> list[Image]:
    """The pictures of a folder, sorted by name. Raises InputError where it has none, or one of another size."""
    if not folder.is_dir():
        raise InputError(f"{folder} is not a folder; name one with pictures of 240 wide x 320 high")
    images = []
    for path in sorted(file for file in folder.iterdir() if file.suffix.lower() in IMAGE_SUFFIXES):
        image = cv2.imread(str(path), cv2.IMREAD_COLOR)
        if image is None or image.shape[:2] != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX):
            seen = "cannot be read" if image is None else f"is {image.shape[1]} wide x {image.shape[0]} high"
            raise InputError(f"{path} {seen}; the sensor's pictures are 240 wide x 320 high")
        images.append(np.asarray(image, np.uint8))
    if not images:
        raise InputError(f"{folder} holds no picture ({', '.join(sorted(IMAGE_SUFFIXES))})")
    return images


def on_the_wire(image: Image, pixels: str, width_px: int, height_px: int) -> bytes:
    """A portrait picture as the sensor sends it: landscape, of the agreed size and format."""
    landscape = cv2.rotate(image, cv2.ROTATE_90_CLOCKWISE)
    if landscape.shape[:2] != (height_px, width_px):
        landscape = cv2.resize(landscape, (width_px, height_px), interpolation=cv2.INTER_LINEAR)
    if pixels == "YUYV":
        return bytes(cv2.cvtColor(landscape, cv2.COLOR_BGR2YUV_YUYV).tobytes())
    return bytes(cv2.imencode(".jpg", landscape, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())
