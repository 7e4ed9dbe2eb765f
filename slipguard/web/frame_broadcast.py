"""Streams of the captured frames: each new frame of a finger to all its clients, for programs.

A message is one frame in the format of the driver `socket`: a header of 28 bytes, then the pixels.
"""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Awaitable, Callable

import numpy as np
from starlette.websockets import WebSocket

from slipguard.daemon.api.daemon_api import FingerFrame
from slipguard.web.errors import error_response
from slipguard.web.streams import send, send_until_disconnected

HEADER = struct.Struct("<4sHHIdQ")
"""Magic, width, height, bytes of pixels, capture time on the monotonic clock, sequence number."""
MAGIC = b"SGF1"
CLIENTS_MAX = 8
"""Of one finger. A frame of 230 kB is copied for each client."""
RETRY_S = 0.1


class FrameBroadcast:
    """The stream of one finger. A slow client misses frames; it delays no other client.

    Frames are requested one at a time, when a client is ready for the next: without clients there is no request.
    fetch: returns the newest frame, and waits while its sequence number is the given one.
    """

    def __init__(self, fetch: Callable[[int | None], Awaitable[FingerFrame]]) -> None:
        self._fetch_newest = fetch
        self._newest: tuple[int, bytes] | None = None
        self._fetching: asyncio.Task[None] | None = None
        self._clients = 0

    async def serve(self, socket: WebSocket) -> None:
        """Send frames until the client disconnects or stops receiving."""
        if self._clients >= CLIENTS_MAX:
            reason = f"at most {CLIENTS_MAX} clients may stream the frames of a finger; close one"
            await socket.send_denial_response(error_response(503, reason))
            return
        self._clients += 1
        try:
            await send_until_disconnected(socket, lambda: self._send_all(socket))
        finally:
            self._clients -= 1

    async def _send_all(self, socket: WebSocket) -> None:
        sent = self._newest  # it may be old: begin with the next one
        while True:
            while self._newest is sent or self._newest is None:
                if self._fetching is None or self._fetching.done():
                    self._fetching = asyncio.create_task(self._fetch(), name="frames: fetch")
                await asyncio.wait((self._fetching,))
            sent = self._newest
            await send(socket, sent[1])

    async def _fetch(self) -> None:
        """Replace the newest frame; after a failure, wait for `RETRY_S`."""
        try:
            found = await self._fetch_newest(None if self._newest is None else self._newest[0])
            self._newest = found.frame.sequence, encode_frame(found)
        except Exception:  # the sensor or the daemon does not respond, which the state shows: try again
            await asyncio.sleep(RETRY_S)


def encode_frame(finger_frame: FingerFrame) -> bytes:
    """Return header and pixels of a frame: rows from top to bottom, B, G, R for each pixel."""
    frame = finger_frame.frame
    height_px, width_px, _ = frame.image.shape
    pixels = np.ascontiguousarray(frame.image).data.cast("B")
    header = HEADER.pack(MAGIC, width_px, height_px, len(pixels), frame.captured_at_s, frame.sequence)
    return b"".join((header, pixels))
