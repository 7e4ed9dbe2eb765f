"""How the daemon and its web process talk: messages of a JSON object and, behind it, bytes.

JSON and no pickle, for the process that strangers talk to must not be able to make the daemon run code.
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
from slipguard.perception.contact.patch import ClippedSides

_HEAD = struct.Struct(">II")
MESSAGE_MAX_BYTES = 4 * 1024 * 1024
COMMANDS = ("grasp", "lift", "lower", "guard", "gripper", "release", "clear", "calibrate", "go_back")
"""Of what can be asked, what changes something: such a message says `until_s`, of the monotonic clock."""
IMAGE_BYTES = FRAME_HEIGHT_PX * FRAME_WIDTH_PX * 3


def encode_message(message: Mapping[str, Any], *behind: bytes | memoryview) -> list[bytes | memoryview]:
    """One message as it goes over the socket, in pieces: what is behind it is large, and not copied."""
    text = json.dumps(message, allow_nan=False).encode()
    return [_HEAD.pack(len(text), sum(map(len, behind))) + text, *behind]


async def read_message(reader: asyncio.StreamReader) -> tuple[dict[str, Any], bytes] | None:
    """The next message; None where the other side is gone. Raises SlipguardError for what is no message."""
    try:
        text_bytes, behind_bytes = _HEAD.unpack(await reader.readexactly(_HEAD.size))
        if text_bytes + behind_bytes > MESSAGE_MAX_BYTES:
            raise SlipguardError(f"a message of {text_bytes + behind_bytes} bytes; at most {MESSAGE_MAX_BYTES}")
        text, behind = await reader.readexactly(text_bytes), await reader.readexactly(behind_bytes)
    except (asyncio.IncompleteReadError, ConnectionError):
        return None
    try:
        message = json.loads(text, parse_constant=_no_number)
    except ValueError as error:
        raise SlipguardError(f"a message that is none: {error}") from None
    if not isinstance(message, dict):
        raise SlipguardError("a message that is no object")
    return message, behind


def _no_number(text: str) -> float:
    raise ValueError(f"{text} is no number")


def encode_finger_frame(view: FingerFrame) -> tuple[dict[str, Any], list[memoryview]]:
    """A view as a message's object and what is behind it: the frame's pixels, then the mask's."""
    told: dict[str, Any] = {
        "serial": view.serial,
        "sequence": view.frame.sequence,
        "captured_at_s": view.frame.captured_at_s,
    }
    contact = view.contact
    if contact is None:
        return told, [_pixels(view.frame.image)]
    sides = contact.clipped
    told["contact"] = {
        "shape": contact.mask.shape,
        "left_px": contact.left_px,
        "top_px": contact.top_px,
        "image_size": contact.image_size,
        "clipped": [sides.left, sides.top, sides.right, sides.bottom],
        "axis_deg": contact.axis_deg,
    }
    return told, [_pixels(view.frame.image), _pixels(contact.mask)]


def _pixels(picture: NDArray[np.uint8]) -> memoryview:
    return np.ascontiguousarray(picture).data.cast("B")


def decode_finger_frame(told: Mapping[str, Any], pixels: bytes) -> FingerFrame:
    """The view that `encode_finger_frame` packed."""
    image = np.frombuffer(pixels, np.uint8, IMAGE_BYTES).reshape(FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3)
    frame = Frame(image, told["captured_at_s"], told["sequence"])
    contact = told.get("contact")
    if contact is None:
        return FingerFrame(told["serial"], frame)
    mask = np.frombuffer(pixels, np.uint8, offset=IMAGE_BYTES).reshape(contact["shape"])
    width, height = contact["image_size"]
    sides = ClippedSides(*contact["clipped"])
    found = ContactOverlay(mask, contact["left_px"], contact["top_px"], (width, height), sides, contact["axis_deg"])
    return FingerFrame(told["serial"], frame, found)
