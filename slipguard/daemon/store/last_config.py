"""The configuration that was last in use: the service starts with it if the file is not valid any more.

Without it, a mistake in the file would show only after the next crash or power cut, when no start succeeds. It is kept
under systemd only, in $STATE_DIRECTORY: by hand, a mistake is better corrected than worked around.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Mapping
from datetime import UTC, datetime
from pathlib import Path

from slipguard.atomic_file import write_atomically
from slipguard.config import CONFIG_MAX_BYTES, Config, file_content, parse_config
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.disk_writer import DiskWriter
from slipguard.errors import ConfigError
from slipguard.limited_read import read_limited

LAST_CONFIG = "last_config.json"


def last_config_path(environ: Mapping[str, str] = os.environ) -> Path | None:
    """Return where the last configuration is kept; None outside of systemd."""
    folder = environ.get("STATE_DIRECTORY", "").split(":")[0]
    return Path(folder) / LAST_CONFIG if folder else None


def read_or_last(read: Callable[[], Config], kept: Path | None) -> tuple[Config, str | None]:
    """Return the file's configuration and None; if it is not valid, the last one in use and what to do.

    Args:
        read: Reads the file; raises ConfigError.
        kept: Where the last one is kept; None: nowhere.

    Raises:
        ConfigError: The file is not valid, and no last one can be used.
    """
    try:
        return read(), None
    except ConfigError as error:
        try:
            if kept is None:
                raise error
            last = parse_config(json.loads(read_limited(kept, CONFIG_MAX_BYTES)), where=str(kept))
            used_at = datetime.fromtimestamp(kept.stat().st_mtime, UTC)
        except (OSError, ValueError, RecursionError, ConfigError):
            raise error from None
        return last, (
            f"{error}. NOT in use: the service runs with its last valid configuration, of {used_at:%Y-%m-%d %H:%M} "
            "UTC. Correct the file, then `systemctl reload slipguard`"
        )


class ConfigSaver:
    """Keeps the configuration once the loop has run with it, and again after each reload."""

    def __init__(
        self, service: Service, path: Path, info: Callable[[str], None], warning: Callable[[str], None]
    ) -> None:
        self._service, self._path = service, path
        self._writer = DiskWriter("save configuration", "the configuration", info, warning)
        self._saved: Config | None = None

    def add_decision(self, decision: Decision) -> None:
        """Write the service's configuration if it is new, or the last write failed."""
        config = self._service.config
        if self._writer.busy or (config is self._saved and not self._writer.due):
            return
        self._saved = config
        content = json.dumps(file_content(config), indent=2).encode()
        self._writer.begin(lambda: write_atomically(self._path, content))
