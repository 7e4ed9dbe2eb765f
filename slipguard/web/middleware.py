"""Security headers on every response, and a limit of requests that are processed at the same time."""

from __future__ import annotations

from collections.abc import Callable

from starlette.datastructures import Headers, MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slipguard.web.errors import error_response

CLIENTS_MAX = 64
UNKNOWN_CLIENTS_MAX = 48
"""Of these without token and cookie: the rest is reserved for clients that may send commands."""
UNKNOWN_STREAMS_MAX = 32
"""Of these on the live stream, which stays open."""
STOP_PATH = "/stop"
"""A stop is never one too many, unless the client may not send it."""
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
"""Another page may neither frame, embed nor read a response; browsers store none."""


class ApiMiddleware:
    """ASGI: adds the headers to every response, and responds 503 beyond `clients_max` requests and streams.

    is_known: whether a request's headers show a client that may send commands; None: all may.
    """

    def __init__(
        self, app: ASGIApp, is_known: Callable[[Headers], bool] | None = None, clients_max: int = CLIENTS_MAX
    ) -> None:
        self._app, self._is_known, self._clients_max = app, is_known, clients_max
        self._clients, self._unknown_clients, self._unknown_streams = 0, 0, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def send_with_headers(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                MutableHeaders(raw=message.setdefault("headers", [])).update(HEADERS)
            await send(message)

        unknown = self._is_known is not None and not self._is_known(Headers(scope=scope))
        unknown_stream = unknown and scope["type"] == "websocket"
        stops = not unknown and scope.get("path") == STOP_PATH
        limit = None if stops else self._exceeded_limit(unknown, unknown_stream)
        if limit is not None:
            await refuse(503, limit, scope, receive, send_with_headers)
            return
        self._count(1, unknown, unknown_stream)
        try:
            await self._app(scope, receive, send_with_headers)
        finally:
            self._count(-1, unknown, unknown_stream)

    def _exceeded_limit(self, unknown: bool, unknown_stream: bool) -> str | None:
        if self._clients >= self._clients_max:
            return f"too many clients: {self._clients_max} requests are being processed; try again later"
        if unknown and self._unknown_clients >= UNKNOWN_CLIENTS_MAX:
            return f"too many clients without the token: at most {UNKNOWN_CLIENTS_MAX} at a time; try again later"
        if unknown_stream and self._unknown_streams >= UNKNOWN_STREAMS_MAX:
            return f"too many live streams without the token: at most {UNKNOWN_STREAMS_MAX} at a time; close one"
        return None

    def _count(self, change: int, unknown: bool, unknown_stream: bool) -> None:
        self._clients += change
        self._unknown_clients += change * unknown
        self._unknown_streams += change * unknown_stream


def without_cookies(app: ASGIApp) -> ASGIApp:
    """Return an ASGI app that receives no cookies: FastAPI would decode them for each route, in quadratic time."""

    async def stripped(scope: Scope, receive: Receive, send: Send) -> None:
        kept = [(name, value) for name, value in scope.get("headers", ()) if name != b"cookie"]
        await app({**scope, "headers": kept}, receive, send)

    return stripped


async def refuse(status: int, reason: str, scope: Scope, receive: Receive, send: Send) -> None:
    """Respond to a request, or to a WebSocket's opening, with an error and close the connection."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": reason[:120]})
        return
    headers = {"www-authenticate": "Bearer"} if status == 401 else {}
    await error_response(status, reason, headers | {"connection": "close"})(scope, receive, send)
