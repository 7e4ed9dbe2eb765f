"""The web process from its first message to its exit. It runs apart, so that a failure here cannot affect the grip."""

from __future__ import annotations

import asyncio
import contextlib
import os
import resource
import socket
from typing import NoReturn

import cv2

from slipguard.daemon import log_setup as log
from slipguard.errors import SlipguardError
from slipguard.web.access import Access
from slipguard.web.daemon_proxy import DaemonProxy
from slipguard.web.protocol import read_message
from slipguard.web.route_context import RouteContext
from slipguard.web.serve import serve


async def run(daemon_socket: socket.socket) -> bool:
    """Serve as the first message says; return True if the daemon asked to stop, False if it has gone."""
    reader, writer = await asyncio.open_connection(sock=daemon_socket)
    received = await read_message(reader)
    if received is None:
        return False
    first, _ = received
    access = None if first["token"] is None else Access(first["token"], (first["host"], first["port"]))
    unix = socket.socket(fileno=first["unix_fd"])
    tcp = None if first["tcp_fd"] is None else socket.socket(fileno=first["tcp_fd"])
    daemon = DaemonProxy(reader, writer)
    serving = asyncio.create_task(serve(RouteContext(daemon, access), unix, tcp), name="serve")
    receiving = asyncio.create_task(daemon.run(), name="receive")
    stopping = asyncio.create_task(daemon.stop.wait(), name="stop")
    await asyncio.wait((serving, receiving, stopping), return_when=asyncio.FIRST_COMPLETED)
    if not stopping.done():
        return False
    serving.cancel()
    await asyncio.wait((serving, receiving), return_when=asyncio.FIRST_COMPLETED)
    return True


def serve_and_exit(socket_fd: int) -> NoReturn:
    """Serve the daemon at the other end of the socket, then exit."""
    cv2.setNumThreads(1)
    _, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (most, most))  # usually 1024 of 524,288: hostile clients take more
    log.configure()
    stopped = False
    with contextlib.suppress(SlipguardError):
        stopped = asyncio.new_event_loop().run_until_complete(run(socket.socket(fileno=socket_fd)))
    # Exit at once, without waiting for requests: a new daemon needs the listening socket that is still open here.
    os._exit(0 if stopped else 1)
