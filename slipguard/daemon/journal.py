"""Log entries in the native format of systemd's journal: a priority, text for people, and a field for each value.

    journalctl -u slipguard -p warning               warnings and faults only
    journalctl -u slipguard SLIPGUARD_EVENT=fault    entries with this value; all fields: -o verbose

The format is described at https://systemd.io/JOURNAL_NATIVE_PROTOCOL.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import socket
import sys
from collections.abc import Mapping
from typing import Any

import structlog

ADDRESS = "/run/systemd/journal/socket"
PRIORITIES = {"debug": 7, "info": 6, "warning": 4, "error": 3, "critical": 2}
IDENTIFIER = "slipguard"
VALUE_MAX = 16_384
"""Characters; the largest entry is then far below the socket's limit of about 200 kB."""
_NOT_IN_NAMES = re.compile(r"[^A-Z0-9_]")
_as_text = structlog.dev.ConsoleRenderer(
    pad_event_to=0, colors=False, exception_formatter=structlog.dev.plain_traceback
)


def stderr_is_journal() -> bool:
    """Return whether systemd has connected stderr to the journal; it names the stream in $JOURNAL_STREAM."""
    try:
        status = os.fstat(sys.stderr.fileno())
    except (OSError, ValueError, AttributeError):
        return False
    return os.environ.get("JOURNAL_STREAM") == f"{status.st_dev}:{status.st_ino}"


def render_entry(logger: object, method: str, event: structlog.typing.EventDict) -> bytes:
    """Return an entry as a datagram; the last of structlog's processors."""
    level = str(event.pop("level", method))
    event.pop("timestamp", None)  # the journal has its own
    fields: dict[str, Any] = {"PRIORITY": PRIORITIES.get(level, PRIORITIES["info"]), "SYSLOG_IDENTIFIER": IDENTIFIER}
    fields |= {f"SLIPGUARD_{_NOT_IN_NAMES.sub('_', key.upper())}": value for key, value in event.items()}
    fields["MESSAGE"] = _as_text(logger, method, event)
    return encode_fields(fields)


def encode_fields(fields: Mapping[str, Any]) -> bytes:
    """Return fields in the journal's format; a value of several lines is preceded by its length."""
    entry = bytearray()
    for name, given in fields.items():
        text = given if isinstance(given, str) else json.dumps(given, default=repr)
        value = text[:VALUE_MAX].encode(errors="replace")
        if b"\n" in value:
            entry += name.encode() + b"\n" + len(value).to_bytes(8, "little") + value + b"\n"
        else:
            entry += name.encode() + b"=" + value + b"\n"
    return bytes(entry)


class JournalOutput:
    """Sends entries to the journal. An entry that cannot be sent is left out."""

    def __init__(self, address: str = ADDRESS) -> None:
        self._address = address

    def write(self, entry: bytes) -> None:
        """Send one entry; waits while the journal is busy."""
        with contextlib.suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.sendto(entry, self._address)
