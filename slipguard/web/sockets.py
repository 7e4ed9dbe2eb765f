"""The sockets the API listens at, made before any device is opened: the Unix socket, and the TCP port beside it."""

from __future__ import annotations

import contextlib
import os
import socket
import stat
from dataclasses import dataclass
from pathlib import Path

from slipguard.errors import ConfigError, SlipguardError

SOCKET_MODE = 0o660
"""Owner and group may command the gripper."""
PATH_MAX_BYTES = 107
"""`sun_path` of Linux, less its closing zero."""


@dataclass(frozen=True, slots=True)
class UnixSocket:
    """A socket that is listened at, and the file that leads to it."""

    listening: socket.socket
    path: Path
    inode: int

    def close(self) -> None:
        """Stop listening, and remove the file unless another daemon has put its own in its place."""
        self.listening.close()
        with contextlib.suppress(OSError):
            if self.path.stat().st_ino == self.inode:
                self.path.unlink()


def bind(path: Path) -> UnixSocket:
    """A Unix socket that only owner and group can use; a dead daemon's file is replaced.

    Raises ConfigError where it cannot be made, SlipguardError where another daemon listens there: one line.
    """
    if len(os.fsencode(path)) > PATH_MAX_BYTES:
        raise ConfigError(f"{_where(path)}: longer than the {PATH_MAX_BYTES} bytes a Unix socket's path may have")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        _clear_stale(path)
        made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            made.bind(str(path))
            path.chmod(SOCKET_MODE)  # before it listens, nobody can connect
            made.setblocking(False)
            made.listen()  # at once: a file that nobody listens at is taken for a dead daemon's
            return UnixSocket(made, path, path.stat().st_ino)
        except BaseException:
            made.close()
            raise
    except OSError as error:
        raise ConfigError(f"{_where(path)}: cannot be made: {error.strerror}") from error


def _where(path: Path) -> str:
    return f"the API's socket {path} (api.socket, or else in state.directory)"


def _clear_stale(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise ConfigError(f"{_where(path)}: is there already and is no socket; name another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise SlipguardError(f"another daemon listens at {path}; stop it first")


def bind_tcp(host: str, port: int) -> socket.socket:
    """A listening TCP socket. Raises SlipguardError with the reason, such as that the port is taken."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    made = socket.socket(family, socket.SOCK_STREAM)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((host, port))
        made.setblocking(False)
        made.listen()
        return made
    except OSError as error:
        made.close()
        raise SlipguardError(f"{host}:{port} cannot be listened at: {error.strerror}") from None
