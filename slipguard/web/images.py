"""The newest picture of a finger, plain or with the contact drawn over it; made once for all who look."""

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
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.perception.contact.patch import Patch
from slipguard.perception.pipeline import resize_mask_to_frame
from slipguard.perception.rotation.skeleton import middle_line
from slipguard.web.ttl_cache import TtlCache

FINGERS = ("left", "right")
FRAME_KEEP_S = 1 / 60
KEEP_S = 0.1
"""A newer picture is asked for after this time at the earliest."""
QUALITY = 85
OUTLINE_BGR = (80, 230, 255)
SKELETON_BGR = (255, 255, 255)
AXIS_BGR = (60, 60, 255)


@dataclass(frozen=True, slots=True)
class EncodedImage:
    """A PNG or JPEG of 240 x 320, of frame `sequence`, taken at `captured_at_s` of the daemon's clock."""

    content: bytes
    serial: str
    sequence: int
    captured_at_s: float


class FingerImages:
    """Of both fingers, encoded in a thread. All methods raise CommandRefused where there is no picture."""

    def __init__(self, control: DaemonApi) -> None:
        self._stored, self._one_stored = control.no_contact, asyncio.Lock()
        self._frames = {name: TtlCache(partial(control.frame, name), FRAME_KEEP_S) for name in FINGERS}
        self._views = {name: TtlCache(partial(control.view, name), KEEP_S) for name in FINGERS}
        self._made: dict[tuple[str, str], tuple[FingerFrame, asyncio.Task[EncodedImage]]] = {}
        self._pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="slipguard-pictures")

    async def raw(self, finger: str) -> EncodedImage:
        """The newest frame of `left` or `right` as it came, a PNG."""
        return await self._once(finger, "png", await self._frames[finger].get(), png_of)

    async def drawn(self, finger: str, overlay: bool) -> EncodedImage:
        """The newest judged frame of `left` or `right`, a JPEG; with what was found in it where `overlay`."""
        encode = overlaid_jpeg_of if overlay else jpeg_of
        return await self._once(finger, encode.__name__, await self._views[finger].get(), encode)

    async def stored(self, finger: str, number: int | None) -> EncodedImage:
        """A stored no-contact image, the newest if not told which, a PNG; one after the other, for the disk is read."""
        async with self._one_stored:
            return await self._make(await self._stored(finger, number), png_of)

    async def _once(
        self, finger: str, kind: str, view: FingerFrame, encode: Callable[[FingerFrame], bytes]
    ) -> EncodedImage:
        """Encode a view once, however many ask for it."""
        of, making = self._made.get((finger, kind), (None, None))
        if making is None or of is not view:
            making = asyncio.create_task(self._make(view, encode), name=f"web: picture {finger}")
            self._made[finger, kind] = view, making
        return await asyncio.shield(making)

    async def _make(self, view: FingerFrame, encode: Callable[[FingerFrame], bytes]) -> EncodedImage:
        content = await asyncio.get_running_loop().run_in_executor(self._pool, encode, view)
        return EncodedImage(content, view.serial, view.frame.sequence, view.frame.captured_at_s)


def png_of(view: FingerFrame) -> bytes:
    """The frame without loss."""
    return bytes(cv2.imencode(".png", view.frame.image, [cv2.IMWRITE_PNG_COMPRESSION, 1])[1].tobytes())


def jpeg_of(view: FingerFrame) -> bytes:
    """The frame for people."""
    return _jpeg(view.frame.image)


def overlaid_jpeg_of(view: FingerFrame) -> bytes:
    """The frame with outline, thinned line and axis of its contact."""
    return _jpeg(view.frame.image if view.contact is None else draw(view.frame.image, view.contact))


def _jpeg(image: NDArray[np.uint8]) -> bytes:
    return bytes(cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])[1].tobytes())


def draw(image: NDArray[np.uint8], contact: ContactOverlay) -> NDArray[np.uint8]:
    """A copy of a frame with what was found in it. image: (320, 240, 3) uint8 BGR."""
    picture = image.copy()
    patch = _patch(contact)
    mask = resize_mask_to_frame(patch.full_mask())
    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, outlines, -1, OUTLINE_BGR, 1)
    rows, columns = np.nonzero(middle_line(patch).skeleton)
    for row, column in zip(rows.tolist(), columns.tolist(), strict=True):
        x_px, y_px = patch.to_frame(column, row)
        row_px, column_px = round(y_px), round(x_px)
        if 0 <= row_px < FRAME_HEIGHT_PX and 0 <= column_px < FRAME_WIDTH_PX:
            picture[row_px, column_px] = SKELETON_BGR
    if contact.axis_deg is not None:
        _draw_axis(picture, mask, contact.axis_deg)
    return picture


def _draw_axis(picture: NDArray[np.uint8], mask: NDArray[np.uint8], axis_deg: float) -> None:
    """A line through the contact's middle, as long as the contact reaches; angles are counter-clockwise, y is down."""
    rows, columns = np.nonzero(mask)
    middle_x, middle_y = columns.mean(), rows.mean()
    right, down = math.cos(math.radians(axis_deg)), -math.sin(math.radians(axis_deg))
    along = (columns - middle_x) * right + (rows - middle_y) * down
    ends = [(round(middle_x + reach * right), round(middle_y + reach * down)) for reach in (along.min(), along.max())]
    cv2.line(picture, ends[0], ends[1], AXIS_BGR, 1, cv2.LINE_AA)


def _patch(contact: ContactOverlay) -> Patch:
    return Patch(
        mask=contact.mask,
        probability=contact.mask.astype(np.float32),
        left_px=contact.left_px,
        top_px=contact.top_px,
        image_size=contact.image_size,
        frame_px=FRAME_WIDTH_PX / contact.image_size[0],
        clipped=contact.clipped,
        regions=1,
    )
