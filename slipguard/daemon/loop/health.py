"""Whether a device works, and why not."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

NOT_TRIED = "not tried yet"
HealthState = Literal["ready", "error", "disconnected"]


@dataclass(slots=True)
class Health:
    """One device's health; written by the task that talks to the device.

    state: `disconnected` (never connected or lost; being retried), `error` (connected, but its last response was
    bad), `ready`.
    """

    name: str
    state: HealthState = "disconnected"
    reason: str = NOT_TRIED
    last_ready_at_s: float | None = None
    """Loop time of the last good response."""

    @property
    def ready(self) -> bool:
        """True after a good response, until the next bad one."""
        return self.state == "ready"

    @property
    def message(self) -> str:
        """The device's name and why it is not ready, in one line."""
        return f"{self.name}: {self.reason.removeprefix(f'{self.name}: ')}"

    def set_ready(self, now_s: float) -> None:
        """Note a good response."""
        self.state, self.reason, self.last_ready_at_s = "ready", "", now_s

    def set_error(self, reason: str) -> None:
        """Note a bad response of a connected device."""
        self.state, self.reason = "error", reason

    def set_disconnected(self, reason: str) -> None:
        """Note that the device is gone and will be retried."""
        self.state, self.reason = "disconnected", reason

    def as_dict(self) -> dict[str, object]:
        """Return the health as the API shows it."""
        return {"state": self.state, "reason": self.reason or None, "last_ready_at_s": self.last_ready_at_s}
