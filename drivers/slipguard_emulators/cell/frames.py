"""Gel images over a Unix socket: one greeting line, then frame after frame.

The greeting is one line of JSON, `{"frames": 1, "serial": "SIM-L", "fps": 60.0}`, or `{"error": why}` and the end.
A frame is a header of 28 bytes, little endian, and its pixels: rows from top to bottom, B, G, R of each pixel.

    magic "SGF1", width u16, height u16, bytes of pixels u32,
    captured at f64 (seconds of CLOCK_MONOTONIC), sequence u64

Both sides run on one machine, so they read the same clock. Whoever sends leaves out frames that the reader has no time
for; the sequence numbers count them all.
"""

from __future__ import annotations

import json
import math
import struct
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

HEADER = struct.Struct("<4sHHIdQ")
MAGIC = b"SGF1"
PIXEL_BYTES = FRAME_WIDTH_PX * FRAME_HEIGHT_PX * 3
PIXEL_BYTES_MAX = 4 * PIXEL_BYTES
"""A frame of more bytes is none: the reader has lost its place in the stream."""
GREETING_MAX_BYTES = 1024
VERSION = 1


class FrameStreamError(Exception):
    """What comes is no stream of frames, or not this version of it; str() says what was seen."""


class FrameGreeting(BaseModel):
    """Who sends. fps: the rate the camera was asked for."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    frames: int
    serial: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    fps: Annotated[float, Field(gt=0.0, le=1000.0)]


@dataclass(frozen=True, slots=True)
class FrameHeader:
    """What stands before the pixels of one frame."""

    width_px: int
    height_px: int
    pixel_bytes: int
    captured_at_s: float
    sequence: int

    @property
    def damage(self) -> str | None:
        """Why the frame cannot be used; None where it can."""
        if (self.width_px, self.height_px, self.pixel_bytes) != (FRAME_WIDTH_PX, FRAME_HEIGHT_PX, PIXEL_BYTES):
            return (
                f"{self.pixel_bytes} bytes for {self.width_px} x {self.height_px} pixels instead of {PIXEL_BYTES} "
                f"for {FRAME_WIDTH_PX} x {FRAME_HEIGHT_PX}"
            )
        return None if math.isfinite(self.captured_at_s) else f"captured at {self.captured_at_s} s"


def greet(serial: str, fps: float) -> bytes:
    """The line that opens a stream."""
    return json.dumps({"frames": VERSION, "serial": serial, "fps": fps}).encode() + b"\n"


def refuse(why: str) -> bytes:
    """The line that stands in place of a stream."""
    return json.dumps({"error": why}).encode() + b"\n"


def read_greeting(line: bytes) -> FrameGreeting:
    """Raises StreamBroken with the sender's refusal, or with what was seen instead of a greeting."""
    try:
        said = json.loads(line)
        if isinstance(said, dict) and "error" in said:
            raise FrameStreamError(str(said["error"]))
        greeting = FrameGreeting.model_validate(said)
    except (ValueError, ValidationError):
        raise FrameStreamError(f"no greeting of a frame server but {line[:40]!r}") from None
    if greeting.frames != VERSION:
        raise FrameStreamError(f"frames of version {greeting.frames}; this driver reads version {VERSION}")
    return greeting


def pack(image: NDArray[np.uint8], captured_at_s: float, sequence: int) -> bytes:
    """One frame. image: (320, 240, 3) uint8 BGR."""
    height, width = image.shape[:2]
    return HEADER.pack(MAGIC, width, height, image.nbytes, captured_at_s, sequence) + image.tobytes()


def read_header(raw: bytes) -> FrameHeader:
    """Take a header apart. Raises StreamBroken where it is none."""
    magic, width, height, size, captured_at_s, sequence = HEADER.unpack(raw)
    if magic != MAGIC:
        raise FrameStreamError(f"{magic!r} where a frame should begin with {MAGIC!r}")
    if size > PIXEL_BYTES_MAX:
        raise FrameStreamError(f"a frame of {size} bytes; at most {PIXEL_BYTES_MAX} make sense")
    return FrameHeader(width, height, size, captured_at_s, sequence)
