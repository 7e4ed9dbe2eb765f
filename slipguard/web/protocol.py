"""Messages between the daemon and its web process: a JSON object, followed by binary data.

JSON and not pickle, because network clients reach the web process: it must not be able to make the daemon execute code.
"""

from __future__ import annotations

import asyncio
import json
import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.api.daemon_api import ContactOverlay, FingerFrame
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX, Frame
from slipguard.errors import SlipguardError
from slipguard.perception.patch import ClippedSides

_HEADER = struct.Struct(">II")
MESSAGE_MAX_BYTES = 4 * 1024 * 1024
IMAGE_BYTES = FRAME_HEIGHT_PX * FRAME_WIDTH_PX * 3


def encode_message(message: Mapping[str, Any], *data: bytes | memoryview) -> list[bytes | memoryview]:
    """Return one message in pieces, so that the data, which is large, is not copied."""
    text = json.dumps(message, allow_nan=False).encode()
    return [_HEADER.pack(len(text), sum(map(len, data))) + text, *data]


async def read_message(reader: asyncio.StreamReader) -> tuple[dict[str, Any], bytes] | None:
    """Return the next message and its data; None at the end of the connection. Raises SlipguardError if invalid."""
    try:
        text_bytes, data_bytes = _HEADER.unpack(await reader.readexactly(_HEADER.size))
        if text_bytes + data_bytes > MESSAGE_MAX_BYTES:
            raise SlipguardError(f"a message of {text_bytes + data_bytes} bytes; at most {MESSAGE_MAX_BYTES}")
        text, data = await reader.readexactly(text_bytes), await reader.readexactly(data_bytes)
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    try:
        message = json.loads(text, parse_constant=_refuse_constant)
    except ValueError as error:
        raise SlipguardError(f"a message is not JSON: {error}") from None
    if not isinstance(message, dict):
        raise SlipguardError("a message is not a JSON object")
    return message, data


def _refuse_constant(text: str) -> float:
    raise ValueError(f"{text} is not a number")


def encode_finger_frame(finger_frame: FingerFrame) -> tuple[dict[str, Any], list[memoryview]]:
    """Return a frame as a JSON object and binary data: the frame's pixels, then the mask's."""
    fields: dict[str, Any] = {
        "serial": finger_frame.serial,
        "sequence": finger_frame.frame.sequence,
        "captured_at_s": finger_frame.frame.captured_at_s,
    }
    contact = finger_frame.contact
    if contact is None:
        return fields, [_pixels(finger_frame.frame.image)]
    sides = contact.clipped
    fields["contact"] = {
        "shape": contact.mask.shape,
        "left_px": contact.left_px,
        "top_px": contact.top_px,
        "image_size": contact.image_size,
        "clipped": [sides.left, sides.top, sides.right, sides.bottom],
        "axis_deg": contact.axis_deg,
    }
    return fields, [_pixels(finger_frame.frame.image), _pixels(contact.mask)]


def _pixels(image: NDArray[np.uint8]) -> memoryview:
    return np.ascontiguousarray(image).data.cast("B")


def decode_finger_frame(fields: Mapping[str, Any], data: bytes) -> FingerFrame:
    """Return the frame that `encode_finger_frame` encoded."""
    image = np.frombuffer(data, np.uint8, IMAGE_BYTES).reshape(FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3)
    frame = Frame(image, fields["captured_at_s"], fields["sequence"])
    contact = fields.get("contact")
    if contact is None:
        return FingerFrame(fields["serial"], frame)
    mask = np.frombuffer(data, np.uint8, offset=IMAGE_BYTES).reshape(contact["shape"])
    width, height = contact["image_size"]
    sides = ClippedSides(*contact["clipped"])
    overlay = ContactOverlay(mask, contact["left_px"], contact["top_px"], (width, height), sides, contact["axis_deg"])
    return FingerFrame(fields["serial"], frame, overlay)
