"""Runs the API in a web process of its own: on the Unix socket, and on TCP if configured."""

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
from slipguard.daemon.loop.async_tools import Backoff
from slipguard.errors import ConfigError, SlipguardError
from slipguard.web.daemon_endpoint import serve_web_process
from slipguard.web.protocol import encode_message
from slipguard.web.sockets import UnixSocket, bind_tcp, token_file

STOP_TIMEOUT_S = 4.0
"""Time for the web process to finish its responses when the daemon stops."""
EXIT_TIMEOUT_S = 1.0
"""Time for the web process to exit after that; then it is killed."""
SEND_BUFFER_BYTES = 512 * 1024
"""Room for a whole frame, so that the loop wakes once to send it."""
RETRY_S, RETRY_MAX_S = 0.5, 30.0
HEALTHY_S = 60.0
"""A web process that ran for longer is replaced after the shortest pause again."""


@dataclass(frozen=True, slots=True)
class TcpListener:
    """A listening port, and the token for commands over it."""

    listening: socket.socket
    host: str
    port: int
    token: str


async def run_api(
    daemon: DaemonApi, unix: UnixSocket, listen: tuple[str, int] | None, token_path: Path, warn: Callable[[str], None]
) -> None:
    """Serve until cancelled, then close `unix`. A web process that ends is replaced; the grip does not depend on it.

    Args:
        daemon: Handles the requests.
        unix: The listening Unix socket.
        listen: Host and port for TCP; None: no TCP. If the port is in use, a warning is given and TCP is not served.
        token_path: The file for the TCP token.
        warn: Called with each warning.
    """
    backoff = Backoff(RETRY_S, RETRY_MAX_S)
    with contextlib.ExitStack() as stack:
        stack.callback(unix.close)
        tcp = _open_tcp(stack, listen, token_path, warn)
        loop = asyncio.get_running_loop()
        while True:
            started_s = loop.time()
            try:
                reason = f"exit status {await _run_web_process(daemon, unix, tcp)}"
            except Exception as failure:  # no failure of the web process may end the control loop
                reason = " ".join(f"{failure}".split()) or type(failure).__name__
            raise_if_cancelled()
            if loop.time() - started_s >= HEALTHY_S:
                backoff.reset()
            warn(f"page and API stopped ({reason}) and are being restarted; the guard is not affected")
            await backoff.wait()


def _open_tcp(
    stack: contextlib.ExitStack, listen: tuple[str, int] | None, token_path: Path, warn: Callable[[str], None]
) -> TcpListener | None:
    if listen is None:
        return None
    host, port = listen
    try:
        listening = stack.enter_context(contextlib.closing(bind_tcp(host, port)))
        token = stack.enter_context(token_file(token_path))
    except (SlipguardError, ConfigError) as error:
        warn(f"no page and no commands over TCP: {error}; the Unix socket works")
        return None
    if not ipaddress.ip_address(host).is_loopback:
        warn(f"the page at {host}:{port} is open to the network without encryption: anyone there can read it")
    return TcpListener(listening, host, port, token)


async def _run_web_process(daemon: DaemonApi, unix: UnixSocket, tcp: TcpListener | None) -> int:
    """Start the web process and respond to it until it ends; return its exit status. If cancelled, stop it."""
    daemon_end, web_end = socket.socketpair()
    listening = [unix.listening] + ([] if tcp is None else [tcp.listening])
    with web_end:
        daemon_end.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER_BYTES)
        reader, writer = await asyncio.open_connection(sock=daemon_end)
        try:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                "-P",  # do not import from the working directory
                "-m",
                "slipguard.web",
                str(web_end.fileno()),
                pass_fds=(web_end.fileno(), *(one.fileno() for one in listening)),
                stdin=asyncio.subprocess.DEVNULL,
                process_group=0,  # a Ctrl-C at the terminal goes to the daemon only
            )
        except BaseException:
            writer.close()
            raise
    writer.write(b"".join(encode_message(_first_message(unix, tcp))))
    serving = asyncio.create_task(serve_web_process(daemon, reader, writer), name="web: serve")
    try:
        await asyncio.shield(serving)
    finally:
        try:
            writer.write(b"".join(encode_message({"stop": True})))  # responses in progress are still sent
            await asyncio.wait((serving,), timeout=STOP_TIMEOUT_S)
            serving.cancel()
            await asyncio.gather(serving, return_exceptions=True)
        finally:
            writer.close()
            status = await wait_or_kill(process, EXIT_TIMEOUT_S)
    return status


async def wait_or_kill(process: asyncio.subprocess.Process, timeout_s: float) -> int:
    """Wait for a process to exit, and kill it after `timeout_s` or if cancelled; return its exit status."""
    try:
        async with asyncio.timeout(timeout_s):
            return await process.wait()
    except (TimeoutError, asyncio.CancelledError) as reason:
        with contextlib.suppress(ProcessLookupError):
            process.kill()  # not earlier: killing a process that has just exited loses its exit status
        killed = asyncio.ensure_future(process.wait())
        try:
            status = await asyncio.shield(killed)
        except asyncio.CancelledError:
            await killed  # returns at once; without it, the transport would stay open
            raise
        if isinstance(reason, asyncio.CancelledError):
            raise
        return status


def _first_message(unix: UnixSocket, tcp: TcpListener | None) -> dict[str, object]:
    return {
        "unix_fd": unix.listening.fileno(),
        "tcp_fd": None if tcp is None else tcp.listening.fileno(),
        "host": None if tcp is None else tcp.host,
        "port": None if tcp is None else tcp.port,
        "token": None if tcp is None else tcp.token,
    }
