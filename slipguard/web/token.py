"""The secret that commands over TCP need: new at each start, for its owner's eyes only."""

from __future__ import annotations

import contextlib
import os
import secrets
from collections.abc import Iterator
from pathlib import Path

from slipguard.errors import ConfigError

TOKEN_BYTES = 32


@contextlib.contextmanager
def token_file(path: Path) -> Iterator[str]:
    """A new token, in a file of mode 0600 for as long as the block lasts. Raises ConfigError where it cannot be."""
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
        raise ConfigError(f"{path}: the API's token cannot be written ({error.strerror}); mend the folder") from error
    try:
        yield token
    finally:
        with contextlib.suppress(OSError, UnicodeDecodeError):
            if path.read_text().strip() == token:  # another daemon may have put its own in its place
                path.unlink()
