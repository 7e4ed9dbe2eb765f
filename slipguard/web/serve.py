"""Serves the API on sockets already made, inside a running event loop, and leaves nothing behind."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator

import uvicorn
from starlette.types import ASGIApp

from slipguard.web.access import AccessMiddleware
from slipguard.web.app import make_app
from slipguard.web.middleware import ApiMiddleware
from slipguard.web.route_context import RouteContext
from slipguard.web.timeouts import TimeoutHttpProtocol

GRACE_S = 1
"""How long answers under way may take when the daemon stops."""
IDLE_S = 5
"""A connection on which nothing more is asked is closed."""
MESSAGE_MAX_BYTES = 4096
"""Nobody needs to say more on the live stream; what is said there is not listened to."""


class _Server(uvicorn.Server):
    """uvicorn without its own signal handlers: signals are the daemon's business."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve(room: RouteContext, unix: socket.socket, tcp: socket.socket | None = None) -> None:
    """Serve until cancelled. tcp: only where the room has an `access`; commands need its token there."""
    app = make_app(room)
    servers = [(_server(ApiMiddleware(app)), unix)]
    if tcp is not None and room.access is not None:
        servers.append((_server(ApiMiddleware(AccessMiddleware(app, room.access), room.access.knows)), tcp))
    live = asyncio.create_task(room.run(), name="web: live")
    serving = [asyncio.create_task(server.serve(sockets=[at]), name="web: http") for server, at in servers]
    try:
        await asyncio.shield(asyncio.gather(*serving))
    except asyncio.CancelledError:
        for server, _ in servers:
            server.should_exit = True
        await asyncio.gather(*serving)
        raise
    finally:
        live.cancel()
        await asyncio.gather(live, return_exceptions=True)


def _server(app: ASGIApp) -> _Server:
    return _Server(
        uvicorn.Config(
            app,
            http=TimeoutHttpProtocol,
            ws="websockets-sansio",
            ws_max_size=MESSAGE_MAX_BYTES,
            ws_per_message_deflate=False,  # it costs more time than loopback costs bytes
            log_config=None,
            log_level="critical",
            access_log=False,
            lifespan="off",
            server_header=False,
            timeout_keep_alive=IDLE_S,
            timeout_graceful_shutdown=GRACE_S,
        )
    )
