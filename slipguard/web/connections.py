"""Timeouts and limits of HTTP connections, and detection of clients that have disconnected.

uvicorn waits without limit for a request that arrives byte by byte; a few hundred of those would use up the process's
file descriptors. It also parses any headers that arrive in one read, up to 256 KiB.
"""

from __future__ import annotations

import asyncio
import select
from collections import deque
from collections.abc import Callable
from functools import partial
from typing import Any

from starlette.types import ASGIApp, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

REQUEST_TIMEOUT_S = 10.0
"""From the first byte, or the start of the connection, to the end of the request's headers; an unknown client must also
have read its response by then."""
HEADERS_MAX_BYTES = 16 * 1024
"""Of a request line with its headers: browsers send the cookies of every program on this host."""
PIECE_BYTES = 4096
"""The parser checks that limit after each piece."""
UNKNOWN_MAX = 64
"""Connections without the token or the cookie. One more closes the one that has been idle longest; it is refused only
if none is idle."""
KNOWN_MAX = 256
"""Connections over the Unix socket, or with the token or the cookie: none is closed for another one."""
_TOO_MANY_BODY = b'{"error": "too many connections"}'
TOO_MANY = (
    b"HTTP/1.1 503 Service Unavailable\r\nconnection: close\r\ncontent-type: application/json\r\ncontent-length: "
    b"%d\r\n\r\n%s" % (len(_TOO_MANY_BODY), _TOO_MANY_BODY)
)
_DISCONNECTED_KEY = "slipguard.disconnected"


class ReceiveQueue:
    """Handles what unknown clients send one at a time, and leaves known clients half of the event loop's time.

    Otherwise one cycle of the loop would serve all connections of hostile clients, and a command of the operator, which
    takes several cycles, would wait for each.
    """

    def __init__(self) -> None:
        self._waiting: deque[Callable[[], None]] = deque()
        self._running = False

    def add(self, loop: asyncio.AbstractEventLoop, handle: Callable[[], None]) -> None:
        """Have `handle` called after those that already wait."""
        self._waiting.append(handle)
        if not self._running:
            self._running = True
            loop.call_soon(self._handle_next, loop)

    def _handle_next(self, loop: asyncio.AbstractEventLoop) -> None:
        self._running = bool(self._waiting)
        if self._running:
            began_s = loop.time()
            try:
                self._waiting.popleft()()
            finally:
                loop.call_soon(self._pause, loop, began_s)

    def _pause(self, loop: asyncio.AbstractEventLoop, began_s: float) -> None:
        """In the next cycle: now the request itself has been handled, too."""
        loop.call_later(loop.time() - began_s, self._handle_next, loop)


class BoundedHttpProtocol(H11Protocol):
    """uvicorn's HTTP/1.1 with a request timeout, a limit of the headers' size and a limit of connections.

    received: what the client has sent already. receive_queue: shared by the connections of unknown clients; None: the
    client is known, and what it sends is handled at once.
    """

    def __init__(
        self, *arguments: Any, received: bytes = b"", receive_queue: ReceiveQueue | None = None, **named: Any
    ) -> None:
        super().__init__(*arguments, **named)
        self._received, self._receive_queue = received, receive_queue
        self._waits_in_queue = False
        self._timeout: asyncio.TimerHandle | None = None
        self._received_at_s = 0.0

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.app = track_disconnect(self.app, transport)
        self._received_at_s = self.loop.time()
        if not self._has_room():
            transport.write(TOO_MANY)
            transport.close()
            return
        self._start_timeout()
        if self._received:
            self._handle(self._received)

    def data_received(self, data: bytes) -> None:
        self._received_at_s = self.loop.time()
        if self._receive_queue is None:
            self._handle(data)
        else:
            self.transport.pause_reading()
            self._waits_in_queue = True
            self._receive_queue.add(self.loop, partial(self._handle_queued, data))

    def _handle_queued(self, data: bytes) -> None:
        self._waits_in_queue = False
        self._handle(data)

    def _handle(self, data: bytes) -> None:
        for start in range(0, len(data), PIECE_BYTES):
            if self.transport.is_closing() or self.transport.get_protocol() is not self:
                break  # refused, or now a WebSocket, which may send nothing before our response
            super().data_received(data[start : start + PIECE_BYTES])
        upgraded = self.transport.get_protocol() is not self
        if self._receive_queue is not None and (upgraded or not self.flow.read_paused):
            self.transport.resume_reading()
        if upgraded or (self._responding and self._is_known):
            self._cancel_timeout()
        elif not self.transport.is_closing() and (self._timeout is None or not self._is_known):
            self._start_timeout()

    def connection_lost(self, exc: Exception | None) -> None:
        self._cancel_timeout()
        super().connection_lost(exc)

    @property
    def _responding(self) -> bool:
        return self.cycle is not None and not self.cycle.response_complete

    def on_response_complete(self) -> None:
        if not self._is_known and self.conn.trailing_data[0]:
            self.transport.close()  # pipelined requests would not wait in the queue
        super().on_response_complete()

    def _has_room(self) -> bool:
        """Return whether this connection is within the limit, after closing an unknown client's if necessary."""
        others = [one for one in self.connections if isinstance(one, BoundedHttpProtocol) and one is not self]
        alike = [one for one in others if one._is_known == self._is_known and not one.transport.is_closing()]
        if self._is_known:
            return len(alike) < KNOWN_MAX
        return len(alike) < UNKNOWN_MAX or self._close_longest_idle(alike)

    @property
    def _is_known(self) -> bool:
        return self._receive_queue is None

    @staticmethod
    def _close_longest_idle(others: list[BoundedHttpProtocol]) -> bool:
        """Close the connection that has been idle longest; return False if none is idle."""
        idle = [one for one in others if not one._responding and not one._waits_in_queue]
        if not idle:
            return False
        min(idle, key=lambda one: one._received_at_s).transport.abort()
        return True

    def _start_timeout(self) -> None:
        self._cancel_timeout()
        self._timeout = self.loop.call_later(REQUEST_TIMEOUT_S, self.transport.abort)

    def _cancel_timeout(self) -> None:
        if self._timeout is not None:
            self._timeout.cancel()
            self._timeout = None


def track_disconnect(app: ASGIApp, transport: asyncio.Transport) -> ASGIApp:
    """Return the ASGI app of one connection, extended so that `is_disconnected` works for its requests."""

    async def tracked(scope: Scope, receive: Receive, send: Send) -> None:
        await app({**scope, _DISCONNECTED_KEY: partial(_hung_up, transport)}, receive, send)

    return tracked


def is_disconnected(scope: Scope) -> bool:
    """Return whether the client of a request has closed its connection; False if that is unknown.

    A web process that was suspended, or has just started, finds old requests whose clients have gone. Such a request
    must not be executed. The request's bytes arrive before the news of the disconnect, so the kernel is asked.
    """
    disconnected = scope.get(_DISCONNECTED_KEY)
    return disconnected is not None and disconnected()


def _hung_up(transport: asyncio.Transport) -> bool:
    if transport.is_closing():
        return True
    poll = select.poll()
    poll.register(transport.get_extra_info("socket").fileno(), select.POLLRDHUP)
    return bool(poll.poll(0))
