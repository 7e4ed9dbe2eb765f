"""Serves an app on a Unix socket inside a running event loop, and leaves nothing behind."""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import uvicorn
from starlette.applications import Starlette

from slipguard.errors import ConfigError, SlipguardError

SOCKET_MODE = 0o660
"""Owner and group may command the gripper."""
PATH_MAX_BYTES = 107
"""`sun_path` of Linux, less its closing zero."""
GRACE_S = 1
"""How long answers under way may take when the daemon stops."""


class _Server(uvicorn.Server):
    """uvicorn without its own signal handlers: signals are the daemon's business."""

    @contextlib.contextmanager
    def capture_signals(self) -> Iterator[None]:
        yield


async def serve(app: Starlette, socket_path: Path, bound: tuple[socket.socket, int] | None = None) -> None:
    """Serve until cancelled; the socket file is gone afterwards.

    bound: what `bind(socket_path)` gave, where that was done before.
    Raises ConfigError where the socket cannot be made, SlipguardError where another daemon listens there.
    """
    listening, inode = bind(socket_path) if bound is None else bound
    config = uvicorn.Config(
        app,
        log_config=None,
        log_level="critical",
        access_log=False,
        lifespan="off",
        ws="none",
        server_header=False,
        timeout_graceful_shutdown=GRACE_S,
    )
    server = _Server(config)
    serving = asyncio.create_task(server.serve(sockets=[listening]), name="http")
    try:
        await asyncio.shield(serving)
    except asyncio.CancelledError:
        server.should_exit = True
        await serving
        raise
    finally:
        listening.close()
        _remove(socket_path, inode)


def _remove(path: Path, inode: int) -> None:
    """Remove the socket file, unless another daemon has put its own in its place."""
    with contextlib.suppress(OSError):
        if path.stat().st_ino == inode:
            path.unlink()


def bind(path: Path) -> tuple[socket.socket, int]:
    """A bound Unix socket that only owner and group can use, and its inode; a dead daemon's file is replaced.

    Raises ConfigError or SlipguardError: one line.
    """
    if len(os.fsencode(path)) > PATH_MAX_BYTES:
        raise ConfigError(f"api.socket = {path}: longer than the {PATH_MAX_BYTES} bytes a Unix socket's path may have")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _clear_stale(path)
        made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            made.bind(str(path))
            path.chmod(SOCKET_MODE)  # before it listens, nobody can connect
            made.setblocking(False)
            made.listen()  # at once: a file that nobody listens at is taken for a dead daemon's
            return made, path.stat().st_ino
        except BaseException:
            made.close()
            raise
    except OSError as error:
        raise ConfigError(f"api.socket = {path}: cannot be made: {error.strerror}") from error


def _clear_stale(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise ConfigError(f"api.socket = {path}: is there already and is no socket; name another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise SlipguardError(f"another daemon listens at {path}; stop it first")
