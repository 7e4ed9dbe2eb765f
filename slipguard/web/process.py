"""The web process from its first message to its end: page and API on the sockets it is given.

Page, API and pictures cost the loop's process nothing but short answers, and a mistake here costs no grip.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
from typing import NoReturn

import cv2

from slipguard.daemon import logging as log
from slipguard.errors import SlipguardError
from slipguard.web.access import Access
from slipguard.web.daemon_proxy import DaemonProxy
from slipguard.web.protocol import read_message
from slipguard.web.route_context import RouteContext
from slipguard.web.serve import serve


async def run(link: socket.socket) -> bool:
    """Serve as the first message says; True where the daemon asked to stop, False where it is gone."""
    reader, writer = await asyncio.open_connection(sock=link)
    received = await read_message(reader)
    if received is None:
        return False
    told, _ = received
    access = None if told["token"] is None else Access(told["token"], (told["host"], told["port"]))
    unix = socket.socket(fileno=told["unix_fd"])
    tcp = None if told["tcp_fd"] is None else socket.socket(fileno=told["tcp_fd"])
    control = DaemonProxy(reader, writer)
    serving = asyncio.create_task(serve(RouteContext(control, access), unix, tcp), name="serve")
    hearing = asyncio.create_task(control.run(), name="hear")
    stopping = asyncio.create_task(control.stop.wait(), name="stop")
    await asyncio.wait((serving, hearing, stopping), return_when=asyncio.FIRST_COMPLETED)
    if not stopping.done():
        return False
    serving.cancel()
    await asyncio.wait((serving, hearing), return_when=asyncio.FIRST_COMPLETED)
    return True


def serve_and_exit(link_fd: int) -> NoReturn:
    """Serve whoever is at the other end of that socket, then end the process."""
    cv2.setNumThreads(1)
    log.configure()
    stopped = False
    with contextlib.suppress(SlipguardError):
        stopped = asyncio.new_event_loop().run_until_complete(run(socket.socket(fileno=link_fd)))
    # A daemon that is gone is followed at once, whatever is under way: its successor needs the socket that is still
    # listened at here.
    os._exit(0 if stopped else 1)
