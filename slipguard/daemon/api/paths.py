"""Paths of a daemon's socket and token, and the search for a running daemon on this machine."""

from __future__ import annotations

import contextlib
import os
import socket
from collections.abc import Mapping
from pathlib import Path
from urllib.parse import urlsplit

from slipguard.config import Config
from slipguard.daemon.store.state_dir import SOCKET_NAME, StateDir
from slipguard.errors import InputError

TOKEN_NAME = "token"
SYSTEM_FOLDER = Path("/run/slipguard")
"""Folder of the daemon that systemd runs."""
CONNECT_TIMEOUT_S = 2.0


def socket_path(config: Config) -> Path:
    """Return the path of the local API's Unix socket."""
    return config.api.socket or StateDir(config.state.directory).runtime_path / SOCKET_NAME


def token_path(config: Config) -> Path:
    """Return the path of the file with the token for commands over TCP."""
    return StateDir(config.state.directory).runtime_path / TOKEN_NAME


def running_socket(config: Config | None = None, environ: Mapping[str, str] = os.environ) -> Path:
    """Return the socket of the running daemon.

    A configured socket is returned as it is. Otherwise the first that accepts connections: this user's, then the
    system's. A socket that this user may not open counts, because its daemon owns the devices. If none accepts
    connections, this user's path is returned.
    """
    if config is not None and config.api.socket is not None:
        return config.api.socket
    own = socket_path(config) if config is not None else StateDir(environ=environ).runtime_path / SOCKET_NAME
    return next((path for path in (own, SYSTEM_FOLDER / SOCKET_NAME) if is_listening(path)), own)


def token_for(url: str, file: Path | None = None) -> str | None:
    """Return the token for the daemon at `url`: from `file`, else this user's, else the system's; None if missing.

    Without `file`, a token is only sent to this machine. Raises InputError if `file` cannot be read.
    """
    if file is not None:
        try:
            return file.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"--token-file {file}: cannot be read: {error}") from None
    try:
        host = urlsplit(url).hostname
    except ValueError:
        return None  # not an address; the client reports it
    if host not in ("127.0.0.1", "localhost", "::1"):
        return None
    for folder in (StateDir().runtime_path, SYSTEM_FOLDER):
        with contextlib.suppress(OSError, UnicodeDecodeError):
            return (folder / TOKEN_NAME).read_text(encoding="ascii").strip()
    return None


def is_listening(path: Path) -> bool:
    """Return whether a daemon accepts connections at a socket, or may do so for other users."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(CONNECT_TIMEOUT_S)
        try:
            probe.connect(str(path))
        except (PermissionError, TimeoutError, BlockingIOError):  # another user's, or busy
            return True
        except OSError:
            return False
    return True
