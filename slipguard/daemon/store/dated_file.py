"""A state file that knows its age: by the computer's uptime within one start, even if the clock is set."""

from __future__ import annotations

import time
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Any

from pydantic import AwareDatetime, BaseModel, ConfigDict, Field

VALID_FOR = timedelta(hours=1)
"""An older file probably belongs to another object."""
BOOT_ID = Path("/proc/sys/kernel/random/boot_id")


class DatedFile(BaseModel):
    """boot_id, uptime_s: start of the computer, and the time since then; empty and 0 if unknown."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    saved_at: AwareDatetime
    boot_id: Annotated[str, Field(max_length=64)] = ""
    uptime_s: Annotated[float, Field(ge=0.0, le=1e10)] = 0.0

    def outdated(self, now: datetime | None = None) -> str | None:
        """Return in words why the file is not recent; None if it is.

        now: by this clock. Default: by the uptime; after another start of the computer, by the computer's clock.
        """
        if now is None and self.boot_id and self.boot_id == _boot_id():
            age = timedelta(seconds=_uptime_s() - self.uptime_s)
        else:
            age = (now or datetime.now(UTC)) - self.saved_at
        if age < timedelta(0):
            return f"saved {_in_words(-age)} in the future; check the computer's clock"
        return f"saved {_in_words(age)} ago (limit {_in_words(VALID_FOR)})" if age > VALID_FOR else None


def save_time() -> dict[str, Any]:
    """Return the fields of `DatedFile` for a file that is saved now."""
    return {"saved_at": datetime.now(UTC), "boot_id": _boot_id(), "uptime_s": _uptime_s()}


def _boot_id() -> str:
    try:
        return BOOT_ID.read_text(encoding="ascii").strip()
    except OSError:
        return ""


def _uptime_s() -> float:
    """Return the time since the computer's start, including suspension."""
    return time.clock_gettime(time.CLOCK_BOOTTIME)


def _in_words(age: timedelta) -> str:
    minutes = age.total_seconds() / 60.0
    return f"{minutes / 60.0:.1f} h" if minutes >= 60.0 else f"{minutes:.0f} min"
