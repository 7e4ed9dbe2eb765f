"""Around every app: what a browser is told about its answers, and how many are answered at once."""

from __future__ import annotations

from starlette.datastructures import MutableHeaders
from starlette.types import ASGIApp, Message, Receive, Scope, Send

from slipguard.web.words import error

CLIENTS_MAX = 64
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


class Shield:
    """ASGI: adds the headers to every answer, and answers 503 beyond `CLIENTS_MAX` requests and streams at once."""

    def __init__(self, app: ASGIApp, clients_max: int = CLIENTS_MAX) -> None:
        self._app, self._clients_max = app, clients_max
        self._clients = 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        async def sending(message: Message) -> None:
            if message["type"] in ("http.response.start", "websocket.http.response.start"):
                MutableHeaders(raw=message.setdefault("headers", [])).update(HEADERS)
            await send(message)

        if self._clients >= self._clients_max:
            await refuse(503, f"{self._clients_max} clients are being answered already", scope, receive, sending)
            return
        self._clients += 1
        try:
            await self._app(scope, receive, sending)
        finally:
            self._clients -= 1


async def refuse(status: int, why: str, scope: Scope, receive: Receive, send: Send) -> None:
    """Answer a request, or a WebSocket's opening, with an error and end the connection."""
    if scope["type"] == "websocket" and "websocket.http.response" not in scope.get("extensions", {}):
        await send({"type": "websocket.close", "code": 1008, "reason": why[:120]})
        return
    asked = {"www-authenticate": "Bearer"} if status == 401 else {}
    await error(status, why, asked | {"connection": "close"})(scope, receive, send)
