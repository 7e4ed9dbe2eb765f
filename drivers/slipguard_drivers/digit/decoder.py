"""Decodes JPEG pictures beside the event loop, the newest first and only."""

from __future__ import annotations

import asyncio

from slipguard.frame_stream import FrameStream
from slipguard_drivers.digit.capture import RawFrame
from slipguard_drivers.digit.pixel_format import DamagedFrame, Image, decode_jpeg


class JpegDecoder:
    """One picture at a time in the loop's thread pool; a picture that comes meanwhile replaces the one that waits."""

    def __init__(self, stream: FrameStream) -> None:
        self._stream = stream
        self._waiting: tuple[RawFrame, float] | None = None
        self._busy = False

    def offer(self, delivery: RawFrame, captured_at_s: float) -> None:
        """Decode it and put it into the stream, unless a newer one comes first."""
        self._waiting = (delivery, captured_at_s)
        if not self._busy:
            self._next()

    def _next(self) -> None:
        if self._waiting is None:
            return
        (delivery, captured_at_s), self._waiting = self._waiting, None
        self._busy = True
        decoding = asyncio.get_running_loop().run_in_executor(None, _decoded, delivery.data)
        decoding.add_done_callback(lambda done: self._on_done(done, delivery, captured_at_s))

    def _on_done(self, done: asyncio.Future[Image | str], delivery: RawFrame, captured_at_s: float) -> None:
        self._busy = False
        if done.cancelled():
            return
        result = done.result()
        if isinstance(result, str):
            self._stream.damaged(result)
        else:
            self._stream.put(result, captured_at_s, delivery.sequence)
        self._next()


def _decoded(data: bytes) -> Image | str:
    """The image, or what is wrong with it."""
    try:
        return decode_jpeg(data)
    except DamagedFrame as damage:
        return str(damage)
