"""The newest image of each finger, with or without the contact drawn over it; encoded once for all clients."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.api.daemon_api import ContactOverlay, DaemonApi, FingerFrame
from slipguard.devices import FINGERS, FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.perception.patch import Patch, resize_mask_to_frame
from slipguard.perception.skeleton import thin
from slipguard.web.ttl_cache import TtlCache

FRAME_TTL_S = 1 / 60
OVERLAY_TTL_S = 0.1
"""A newer image is requested after this time at the earliest."""
JPEG_QUALITY = 85
CONTOUR_BGR = (80, 230, 255)
SKELETON_BGR = (255, 255, 255)
AXIS_BGR = (60, 60, 255)


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A PNG or JPEG of 240 x 320 pixels, of frame `sequence`. captured_at_s: on the daemon's clock."""

    content: bytes
    serial: str
    sequence: int
    captured_at_s: float


class FingerImages:
    """Images of both fingers, encoded in a thread. Methods raise CommandRefused if there is no image."""

    def __init__(self, daemon: DaemonApi) -> None:
        self._fetch_background, self._background_lock = daemon.background, asyncio.Lock()
        self._frames = {name: TtlCache(partial(daemon.frame, name), FRAME_TTL_S) for name in FINGERS}
        self._processed = {name: TtlCache(partial(daemon.processed_frame, name), OVERLAY_TTL_S) for name in FINGERS}
        self._encoding: dict[tuple[str, str], tuple[FingerFrame, asyncio.Task[EncodedImage]]] = {}
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slipguard-images")

    async def raw(self, finger: str) -> EncodedImage:
        """Return the newest frame of `left` or `right` as it was captured, a PNG."""
        return await self._encode_once(finger, "png", await self._frames[finger].get(), encode_png)

    async def with_overlay(self, finger: str, overlay: bool) -> EncodedImage:
        """Return the newest processed frame of `left` or `right`, a JPEG; with its contact if `overlay`."""
        encode = encode_jpeg_with_overlay if overlay else encode_jpeg
        return await self._encode_once(finger, encode.__name__, await self._processed[finger].get(), encode)

    async def background(self, finger: str, number: int | None) -> EncodedImage:
        """Return a stored background image, by default the newest, a PNG. One at a time, because it reads the disk."""
        async with self._background_lock:
            return await self._encode(await self._fetch_background(finger, number), encode_png)

    async def _encode_once(
        self, finger: str, kind: str, frame: FingerFrame, encode: Callable[[FingerFrame], bytes]
    ) -> EncodedImage:
        """Encode a frame once, also if several clients request it at the same time."""
        encoded, task = self._encoding.get((finger, kind), (None, None))
        if task is None or encoded is not frame:
            task = asyncio.create_task(self._encode(frame, encode), name=f"web: image {finger}")
            self._encoding[finger, kind] = frame, task
        return await asyncio.shield(task)

    async def _encode(self, frame: FingerFrame, encode: Callable[[FingerFrame], bytes]) -> EncodedImage:
        content = await asyncio.get_running_loop().run_in_executor(self._pool, encode, frame)
        return EncodedImage(content, frame.serial, frame.frame.sequence, frame.frame.captured_at_s)


def encode_png(frame: FingerFrame) -> bytes:
    """Return the frame as a PNG, lossless."""
    return bytes(cv2.imencode(".png", frame.frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def encode_jpeg(frame: FingerFrame) -> bytes:
    """Return the frame as a JPEG, for display."""
    return _jpeg(frame.frame.image)


def encode_jpeg_with_overlay(frame: FingerFrame) -> bytes:
    """Return the frame as a JPEG, with contour, skeleton and axis of its contact."""
    return _jpeg(frame.frame.image if frame.contact is None else draw_contact(frame.frame.image, frame.contact))


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes())


def draw_contact(image: NDArray[np.uint8], contact: ContactOverlay) -> NDArray[np.uint8]:
    """Return a copy of a frame, (320, 240, 3) uint8 BGR, with its contact drawn over it."""
    drawn = image.copy()
    patch = _patch(contact)
    mask = resize_mask_to_frame(patch.full_mask())
    contours, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(drawn, contours, -1, CONTOUR_BGR, 1)
    rows, columns = np.nonzero(thin(patch.mask))
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        x_px, y_px = patch.to_frame(column, row)
        row_px, column_px = round(y_px), round(x_px)
        if 0 <= row_px < FRAME_HEIGHT_PX and 0 <= column_px < FRAME_WIDTH_PX:
            drawn[row_px, column_px] = SKELETON_BGR
    if contact.axis_deg is not None:
        _draw_axis(drawn, mask, contact.axis_deg)
    return drawn


def _draw_axis(image: NDArray[np.uint8], mask: NDArray[np.uint8], axis_deg: float) -> None:
    """Draw the axis through the contact's center, as long as the contact; counter-clockwise angles, y points down."""
    rows, columns = np.nonzero(mask)
    center_x, center_y = columns.mean(), rows.mean()
    right, down = math.cos(math.radians(axis_deg)), -math.sin(math.radians(axis_deg))
    along = (columns - center_x) * right + (rows - center_y) * down
    ends = [(round(center_x + reach * right), round(center_y + reach * down)) for reach in (along.min(), along.max())]
    cv2.line(image, ends[0], ends[1], AXIS_BGR, 1, cv2.LINE_AA)


def _patch(contact: ContactOverlay) -> Patch:
    return Patch(
        mask=contact.mask,
        probability=contact.mask.astype(np.float32),
        left_px=contact.left_px,
        top_px=contact.top_px,
        image_size=contact.image_size,
        frame_px=FRAME_WIDTH_PX / contact.image_size[0],
        clipped=contact.clipped,
    )
