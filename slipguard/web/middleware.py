"""Around every app: what a browser is told about its answers, and how many are answered at once."""

from __future__ import annotations

from collections.abc import Callable

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slipguard.web.errors import error

CLIENTS_MAX = 64
STRANGERS_MAX = 48
"""Of them without token and cookie: the rest is kept for whoever may command."""
STRANGE_STREAMS_MAX = 32
"""Of those on the live stream, which nobody leaves by himself."""
HEADERS = {
    "content-security-policy": "default-src 'self'; img-src 'self' blob:; frame-ancestors 'none'; base-uri 'none'; "
    "form-action 'none'",
    "x-frame-options": "DENY",
    "x-content-type-options": "nosniff",
    "referrer-policy": "no-referrer",
    "cross-origin-resource-policy": "same-origin",
    "cross-origin-opener-policy": "same-origin",
    "cache-control": "no-store",
}
"""No foreign page may frame, embed or read anything of ours, and nothing is kept."""


class ApiMiddleware:
    """ASGI: adds the headers to every answer, and answers 503 beyond `clients_max` requests and streams at once.

    knows: whether a request's headers tell of somebody who may command; None: all may.
    """

    def __init__(
        self, app: ASGIApp, knows: Callable[[Headers], bool] | None = None, clients_max: int = CLIENTS_MAX
    ) -> None:
        self._app, self._knows, self._clients_max = app, knows, clients_max
        self._clients, self._strangers, self._strange_streams = 0, 0, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sending(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                MutableHeaders(raw=message.setdefault("headers", [])).update(HEADERS)
            await send(message)

        strange = self._knows is not None and not self._knows(Headers(scope=scope))
        streams = strange and scope["type"] == "websocket"
        full = self._full(strange, streams)
        if full is not None:
            await refuse(503, full, scope, receive, sending)
            return
        self._count(1, strange, streams)
        try:
            await self._app(scope, receive, sending)
        finally:
            self._count(-1, strange, streams)

    def _full(self, strange: bool, streams: bool) -> str | None:
        if self._clients >= self._clients_max:
            return f"{self._clients_max} clients are being answered already"
        if strange and self._strangers >= STRANGERS_MAX:
            return f"{STRANGERS_MAX} clients without the token are being answered already"
        if streams and self._strange_streams >= STRANGE_STREAMS_MAX:
            return f"{STRANGE_STREAMS_MAX} clients without the token hear the live stream already"
        return None

    def _count(self, one: int, strange: bool, streams: bool) -> None:
        self._clients += one
        self._strangers += one * strange
        self._strange_streams += one * streams


async def refuse(status: int, why: str, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request, or a WebSocket's opening, with an error and end the connection."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": why[:120]})
        return
    asked = {"www-authenticate": "Bearer"} if status == 401 else {}
    await error(status, why, asked | {"connection": "close"})(scope, receive, send)
