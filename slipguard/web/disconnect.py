"""Whether whoever asked is still there: a command that was given up must not come true later.

A web process that was stopped, or is just started, finds requests that wait since nobody knows when. Their bytes come
first and the news of the client's going behind them, so that the kernel is asked before anything is done.
"""

from __future__ import annotations

import asyncio
import select
from functools import partial

from starlette.types import ASGIApp, Receive, Scope, Send

_GONE_KEY = "slipguard.gone"


def track_disconnect(app: ASGIApp, transport: asyncio.Transport) -> ASGIApp:
    """ASGI: `app` for one connection, so that `is_disconnected` can tell of it."""

    async def knowing(scope: Scope, receive: Receive, send: Send) -> None:
        await app({**scope, _GONE_KEY: partial(_hung_up, transport)}, receive, send)

    return knowing


def is_disconnected(scope: Scope) -> bool:
    """Whether the client of a request has closed its connection by now, read or not; False where nobody can know."""
    gone = scope.get(_GONE_KEY)
    return gone is not None and gone()


def _hung_up(transport: asyncio.Transport) -> bool:
    if transport.is_closing():
        return True
    look = select.poll()
    look.register(transport.get_extra_info("socket").fileno(), select.POLLRDHUP)
    return bool(look.poll(0))
