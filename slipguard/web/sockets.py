"""The API's Unix socket and TCP port, opened before any device, and the token file for commands over TCP."""

from __future__ import annotations

import contextlib
import fcntl
import grp
import os
import secrets
import socket
import stat
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from slipguard.errors import ConfigError, SlipguardError

SOCKET_GROUP = "dialout"
"""May send commands, too: its members can command the gripper without slipguard, over the serial port."""
PATH_MAX_BYTES = 107
"""Linux, `sun_path` without its closing zero."""
TOKEN_BYTES = 32


@dataclass(frozen=True, slots=True)
class UnixSocket:
    """A listening socket and its file."""

    listening: socket.socket
    path: Path
    inode: int

    def close(self) -> None:
        """Close the socket, and remove the file unless another daemon has replaced it."""
        with contextlib.suppress(OSError):
            if self.path.stat().st_ino == self.inode:
                self.path.unlink()
        self.listening.close()  # last: until then the kernel gives the number of its inode to no other file


def bind(path: Path) -> UnixSocket:
    """Open a Unix socket that only its owner and `SOCKET_GROUP` may use; the file of a dead daemon is replaced.

    Raises ConfigError if it cannot be created, SlipguardError if another daemon is listening there.
    """
    if len(os.fsencode(path)) > PATH_MAX_BYTES:
        raise ConfigError(
            f"{_name(path)}: the path is longer than {PATH_MAX_BYTES} bytes, the maximum for a Unix socket"
        )
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with _one_at_a_time(path.parent):
            _remove_stale(path)
            made = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
            try:
                made.bind(str(path))
                _set_permissions(path)  # before `listen`: until then, no client can connect
                made.setblocking(False)
                made.listen()  # at once: a socket that does not listen is taken for a dead daemon's
                return UnixSocket(made, path, path.stat().st_ino)
            except BaseException:
                made.close()
                raise
    except OSError as error:
        raise ConfigError(f"{_name(path)}: cannot be created: {error.strerror}") from error


@contextlib.contextmanager
def _one_at_a_time(folder: Path) -> Iterator[None]:
    """Let other daemons wait: of two that start, the second could remove the socket that the first has just bound."""
    lock = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def _set_permissions(path: Path) -> None:
    """Admit `SOCKET_GROUP` if it exists and has this process as a member, else the owner only."""
    try:
        group = grp.getgrnam(SOCKET_GROUP).gr_gid
        if path.stat().st_gid != group:  # the service may not change the group, but already has this one
            os.chown(path, -1, group)
        path.chmod(0o660)
    except (KeyError, PermissionError):
        path.chmod(0o600)


def _name(path: Path) -> str:
    return f"the API's socket {path} (api.socket, or else in state.directory)"


def _remove_stale(path: Path) -> None:
    try:
        mode = path.stat().st_mode
    except FileNotFoundError:
        return
    if not stat.S_ISSOCK(mode):
        raise ConfigError(f"{_name(path)}: the file exists and is not a socket; use another path")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except ConnectionRefusedError:
            path.unlink()
            return
    raise SlipguardError(f"another daemon is listening at {path}; stop it first")


def bind_tcp(host: str, port: int) -> socket.socket:
    """Open a listening TCP socket. Raises SlipguardError with the reason, for example that the port is in use."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Only with the protocol given does asyncio set TCP_NODELAY; without it, each response is delayed by 40 ms.
    made = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    try:
        made.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        made.bind((host, port))
        made.setblocking(False)
        made.listen()
        return made
    except OSError as error:
        made.close()
        raise SlipguardError(f"cannot listen on {host}:{port}: {error.strerror}") from None


@contextlib.contextmanager
def token_file(path: Path) -> Iterator[str]:
    """Provide a new token, in a file of mode 0600 during the block. Raises ConfigError if it cannot be written."""
    token = secrets.token_hex(TOKEN_BYTES)
    new = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new.unlink(missing_ok=True)
        with os.fdopen(os.open(new, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_NOFOLLOW, 0o600), "w") as file:
            os.fchmod(file.fileno(), 0o600)
            file.write(token + "\n")
        new.replace(path)
    except OSError as error:
        raise ConfigError(
            f"{path}: the API's token cannot be written ({error.strerror}); check the folder and its permissions"
        ) from error
    try:
        yield token
    finally:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            if path.read_text().strip() == token:  # another daemon may have replaced it
                path.unlink()
