"""How long a client may take to say what it wants, and how many connections there may be.

uvicorn waits for ever for a request that comes byte by byte; a few hundred of those would use up the daemon's files.
"""

from __future__ import annotations

import asyncio
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from slipguard.web.disconnect import track_disconnect

REQUEST_S = 10.0
"""From the first byte, or the connection's beginning, to the end of the request's headers."""
CONNECTIONS_MAX = 128
"""One more ends the one that has said nothing for longest; only where all are being answered is it turned away."""
BODY = b'{"error": "too many connections"}'
FULL = b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-type: application/json\r\ncontent-length: "


class TimeoutHttpProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, with an end to its patience."""

    def __init__(self, *arguments: Any, **named: Any) -> None:
        super().__init__(*arguments, **named)
        self._impatience: asyncio.TimerHandle | None = None
        self._heard_at_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.app = track_disconnect(self.app, transport)
        self._heard_at_s = self.loop.time()
        if len(self.connections) > CONNECTIONS_MAX and not self._one_gives_way():
            transport.write(FULL + f"{len(BODY)}\r\n\r\n".encode() + BODY)
            transport.close()
            return
        self._wait()

    def data_received(self, data: bytes) -> None:
        self._heard_at_s = self.loop.time()
        super().data_received(data)
        upgraded = self.transport.get_protocol() is not self
        if upgraded or self._answering:
            self._wait_no_more()
        elif self._impatience is None and not self.transport.is_closing():
            self._wait()

    def connection_lost(self, exc: Exception | None) -> None:
        self._wait_no_more()
        super().connection_lost(exc)

    @property
    def _answering(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def _one_gives_way(self) -> bool:
        """Nobody may keep all places taken by saying nothing: that would lock out whoever may command."""
        others = [one for one in self.connections if isinstance(one, TimeoutHttpProtocol) and one is not self]
        idle = [one for one in others if not one._answering and not one.transport.is_closing()]
        if not idle:
            return False
        min(idle, key=lambda one: one._heard_at_s).transport.abort()
        return True

    def _wait(self) -> None:
        self._impatience = self.loop.call_later(REQUEST_S, self.transport.abort)

    def _wait_no_more(self) -> None:
        if self._impatience is not None:
            self._impatience.cancel()
            self._impatience = None
