"""Where a daemon's socket and token are, and which daemon on this machine is running."""

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
"""Of the daemon that systemd runs."""
KNOCK_S = 2.0


def socket_path(config: Config) -> Path:
    """Where the local API listens."""
    return config.api.socket or StateDir(config.state.directory).runtime_path / SOCKET_NAME


def token_path(config: Config) -> Path:
    """Where the token lies that commands over TCP need."""
    return StateDir(config.state.directory).runtime_path / TOKEN_NAME


def running_socket(config: Config | None = None, environ: Mapping[str, str] = os.environ) -> Path:
    """Where to ask for a running daemon: at the configured socket; else at this user's own, else at the system's.

    The first at which one listens; one that this user may not ask counts, for it has the devices. This user's own
    where none listens. config: None: nothing is configured. Raises nothing.
    """
    if config is not None and config.api.socket is not None:
        return config.api.socket
    own = socket_path(config) if config is not None else StateDir(environ=environ).runtime_path / SOCKET_NAME
    return next((path for path in (own, SYSTEM_FOLDER / SOCKET_NAME) if _listens(path)), own)


def token_for(url: str, file: Path | None = None, environ: Mapping[str, str] = os.environ) -> str | None:
    """The token for a daemon at `url`: from `file`, else this user's own, else the system's; None where there is none.

    A token that nobody named is given to this machine alone. Raises InputError where `file` cannot be read.
    """
    if file is not None:
        try:
            return file.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise InputError(f"--token-file {file}: cannot be read: {error}") from None
    try:
        host = urlsplit(url).hostname
    except ValueError:
        return None  # no address at all, which whoever asks there will say
    if host not in ("127.0.0.1", "localhost", "::1"):
        return None
    for folder in (StateDir(environ=environ).runtime_path, SYSTEM_FOLDER):
        with contextlib.suppress(OSError, UnicodeDecodeError):
            return (folder / TOKEN_NAME).read_text(encoding="ascii").strip()
    return None


def _listens(path: Path) -> bool:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(KNOCK_S)
        try:
            probe.connect(str(path))
        except (PermissionError, TimeoutError, BlockingIOError):  # not for us, or busy
            return True
        except OSError:
            return False
    return True
