"""The API of a daemon: on its Unix socket always, on TCP beside it where that can be."""

from __future__ import annotations

import contextlib
import ipaddress
import socket
from collections.abc import Callable
from pathlib import Path

from slipguard.daemon.control import Control
from slipguard.errors import ConfigError, SlipguardError
from slipguard.web.access import Access
from slipguard.web.room import Room
from slipguard.web.serve import serve
from slipguard.web.sockets import UnixSocket, bind_tcp
from slipguard.web.token import token_file


async def run_api(
    control: Control, unix: UnixSocket, listen: tuple[str, int] | None, token_at: Path, warn: Callable[[str], None]
) -> None:
    """Serve until cancelled, and close `unix`.

    listen: host and port for TCP too; None: none. A port that cannot be had is warned of, and done without: nobody's
    grip depends on a page. token_at: where the token for TCP is written.
    """
    with contextlib.ExitStack() as stack:
        stack.callback(unix.close)
        tcp, access = _tcp(stack, listen, token_at, warn)
        await serve(Room(control, access), unix.listening, tcp)


def _tcp(
    stack: contextlib.ExitStack, listen: tuple[str, int] | None, token_at: Path, warn: Callable[[str], None]
) -> tuple[socket.socket | None, Access | None]:
    if listen is None:
        return None, None
    host, port = listen
    try:
        tcp = stack.enter_context(contextlib.closing(bind_tcp(host, port)))
        token = stack.enter_context(token_file(token_at))
    except (SlipguardError, ConfigError) as error:
        warn(f"no page, and no commands over TCP: {error}; the Unix socket works")
        return None, None
    if not ipaddress.ip_address(host).is_loopback:
        warn(f"the page at {host}:{port} is open to the network, unencrypted: anybody may look, and read along")
    return tcp, Access(token, (host, tcp.getsockname()[1]))
