"""The API of a daemon: a process of its own beside the loop, on its Unix socket always, on TCP where that can be."""

from __future__ import annotations

import asyncio
import contextlib
import ipaddress
import socket
import sys
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from slipguard.cancellation import raise_if_cancelled
from slipguard.daemon.api.daemon_api import DaemonApi
from slipguard.daemon.loop.backoff import Backoff
from slipguard.errors import ConfigError, SlipguardError
from slipguard.web.daemon_endpoint import answer
from slipguard.web.protocol import encode_message
from slipguard.web.sockets import UnixSocket, bind_tcp
from slipguard.web.token import token_file

STOP_S = 4.0
"""How long the web process may take to finish its answers when the daemon stops."""
SEND_BYTES = 512 * 1024
"""A frame goes out in one piece, so that the loop is woken for it once."""
RETRY_S, RETRY_MAX_S = 0.5, 30.0
WELL_S = 60.0
"""A web process that lived so long was well: the next one comes after the first pause again."""
GONE_S = 1.0
"""... and to be gone once nobody talks to it any more."""


@dataclass(frozen=True, slots=True)
class TcpListener:
    """A port that is listened at, and the token that commands need there."""

    listening: socket.socket
    host: str
    port: int
    token: str


async def run_api(
    control: DaemonApi, unix: UnixSocket, listen: tuple[str, int] | None, token_at: Path, warn: Callable[[str], None]
) -> None:
    """Serve until cancelled, and close `unix`. A web process that ends is replaced; nobody's grip depends on it.

    listen: host and port for TCP too; None: none. A port that cannot be had is warned of, and done without.
    token_at: where the token for TCP is written.
    """
    backoff = Backoff(RETRY_S, RETRY_MAX_S)
    with contextlib.ExitStack() as stack:
        stack.callback(unix.close)
        tcp = _tcp(stack, listen, token_at, warn)
        loop = asyncio.get_running_loop()
        while True:
            began_s = loop.time()
            try:
                why = f"exit status {await _until_it_ends(control, unix, tcp)}"
            except Exception as trouble:  # whatever it is, it is no reason to let go of the loop
                why = " ".join(f"{trouble}".split()) or type(trouble).__name__
            raise_if_cancelled()
            if loop.time() - began_s >= WELL_S:
                backoff.reset()
            warn(f"page and API ended ({why}) and are started again; the guard goes on")
            await backoff.wait()


def _tcp(
    stack: contextlib.ExitStack, listen: tuple[str, int] | None, token_at: Path, warn: Callable[[str], None]
) -> TcpListener | None:
    if listen is None:
        return None
    host, port = listen
    try:
        listening = stack.enter_context(contextlib.closing(bind_tcp(host, port)))
        token = stack.enter_context(token_file(token_at))
    except (SlipguardError, ConfigError) as error:
        warn(f"no page, and no commands over TCP: {error}; the Unix socket works")
        return None
    if not ipaddress.ip_address(host).is_loopback:
        warn(f"the page at {host}:{port} is open to the network, unencrypted: anybody may look, and read along")
    return TcpListener(listening, host, port, token)


async def _until_it_ends(control: DaemonApi, unix: UnixSocket, tcp: TcpListener | None) -> int:
    """Start the web process and answer it until it ends, with its exit status; it is ended where this is cancelled."""
    ours, theirs = socket.socketpair()
    served = [unix.listening] + ([] if tcp is None else [tcp.listening])
    with theirs:
        ours.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BYTES)
        reader, writer = await asyncio.open_connection(sock=ours)
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # the working directory of whoever started the daemon is no place to import from
                "-m",
                "slipguard.web",
                str(theirs.fileno()),
                pass_fds=(theirs.fileno(), *(one.fileno() for one in served)),
                stdin=asyncio.subprocess.DEVNULL,
                process_group=0,  # a Ctrl-C at the terminal is for the daemon alone
            )
        except BaseException:
            writer.close()
            raise
    writer.write(b"".join(encode_message(_first_words(unix, tcp))))
    answering = asyncio.create_task(answer(control, reader, writer), name="web: answers")
    try:
        await asyncio.shield(answering)
    finally:
        writer.write(b"".join(encode_message({"stop": True})))  # answers under way are still given
        await asyncio.wait((answering,), timeout=STOP_S)
        answering.cancel()
        await asyncio.gather(answering, return_exceptions=True)
        writer.close()
        ended = await end(process, GONE_S)
    return ended


async def end(process: asyncio.subprocess.Process, within_s: float) -> int:
    """Wait for a process that should end by itself, and kill it after `within_s`; its exit status."""
    try:
        async with asyncio.timeout(within_s):
            return await process.wait()
    except TimeoutError:
        process.kill()  # not before: a kill that meets a process just gone takes its status from who waits for it
        killed = asyncio.ensure_future(process.wait())
        try:
            return await asyncio.shield(killed)
        except asyncio.CancelledError:
            await killed  # it is gone in no time, and else its transport would be left open
            raise


def _first_words(unix: UnixSocket, tcp: TcpListener | None) -> dict[str, object]:
    return {
        "unix_fd": unix.listening.fileno(),
        "tcp_fd": None if tcp is None else tcp.listening.fileno(),
        "host": None if tcp is None else tcp.host,
        "port": None if tcp is None else tcp.port,
        "token": None if tcp is None else tcp.token,
    }
