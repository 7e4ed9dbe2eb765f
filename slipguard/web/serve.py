"""Serves the API on listening sockets, inside a running event loop."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Iterator
from functools import partial

import uvicorn
from starlette.types import ASGIApp

from slipguard.web.acceptor import Acceptor
from slipguard.web.access import Access, AccessMiddleware
from slipguard.web.app import make_app
from slipguard.web.connections import HEADERS_MAX_BYTES, BoundedHttpProtocol
from slipguard.web.middleware import ApiMiddleware, without_cookies
from slipguard.web.route_context import RouteContext

SHUTDOWN_TIMEOUT_S = 1
"""Time for requests in progress when the daemon stops."""
ACCEPTED_MAX = 2
"""Connections to the Unix socket that one cycle of the event loop accepts."""
WAITING_MAX = 128
"""Connections to the Unix socket that wait to be accepted."""
KEEP_ALIVE_S = 5
"""An idle connection is closed after this time."""
WEBSOCKET_MESSAGE_MAX_BYTES = 4096
"""The live stream reads no messages from clients."""


class _Server(uvicorn.Server):
    """uvicorn without its own signal handlers: the daemon handles signals."""

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        """Start, with room for more connections than asyncio accepts at a time; it takes both from one number."""
        await super().startup(sockets)
        for listening in sockets or ():
            listening.listen(WAITING_MAX)

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


class _TcpServer(_Server):
    """A server whose connections are accepted by an `Acceptor`."""

    def __init__(self, config: uvicorn.Config, listening: socket.socket, access: Access) -> None:
        super().__init__(config)
        self._listening, self._access = listening, access
        self._acceptor: Acceptor | None = None

    async def startup(self, sockets: list[socket.socket] | None = None) -> None:
        await super().startup(sockets)
        make_protocol = partial(
            BoundedHttpProtocol, self.config, server_state=self.server_state, app_state=self.lifespan.state
        )
        self._acceptor = Acceptor(self._listening, self._access.may_be_known, make_protocol)

    async def shutdown(self, sockets: list[socket.socket] | None = None) -> None:
        if self._acceptor is not None:
            self._acceptor.close()
        await super().shutdown(sockets)


async def serve(context: RouteContext, unix: socket.socket, tcp: socket.socket | None = None) -> None:
    """Serve until cancelled. tcp: served only if the context has an `access`; commands need its token there."""
    app = without_cookies(make_app(context))
    servers: list[tuple[_Server, list[socket.socket]]] = [(_Server(_config(ApiMiddleware(app))), [unix])]
    if tcp is not None and context.access is not None:
        protected = AccessMiddleware(app, context.access)
        config = _config(ApiMiddleware(protected, context.access.is_known))
        servers.append((_TcpServer(config, tcp, context.access), []))
    live = asyncio.create_task(context.run(), name="web: live")
    serving = [asyncio.create_task(server.serve(sockets=listening), name="web: http") for server, listening in servers]
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


def _config(app: ASGIApp) -> uvicorn.Config:
    return uvicorn.Config(
        app,
        http=BoundedHttpProtocol,
        backlog=ACCEPTED_MAX,
        h11_max_incomplete_event_size=HEADERS_MAX_BYTES,
        ws="websockets-sansio",
        ws_max_size=WEBSOCKET_MESSAGE_MAX_BYTES,
        ws_per_message_deflate=False,  # on loopback, compressing takes longer than sending
        log_config=None,
        log_level="critical",
        access_log=False,
        lifespan="off",
        server_header=False,
        timeout_keep_alive=KEEP_ALIVE_S,
        timeout_graceful_shutdown=SHUTDOWN_TIMEOUT_S,
    )
