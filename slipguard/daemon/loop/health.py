"""How a device is, in a word and a sentence."""

from __future__ import annotations

from dataclasses import dataclass

NOT_TRIED = "not tried yet"


@dataclass(slots=True)
class Health:
    """One device's health.

    state: `waiting` (never seen yet or gone; being retried), `troubled` (there, but its last answer was bad), `ready`.
    """

    name: str
    state: str = "waiting"
    why: str = NOT_TRIED
    good_at_s: float | None = None
    """Loop time of the last good answer."""

    @property
    def ready(self) -> bool:
        """True after a good answer, until the next bad one."""
        return self.state == "ready"

    @property
    def line(self) -> str:
        """Who it is and why it is not ready; a driver's own words may begin with its name already."""
        return f"{self.name}: {self.why.removeprefix(f'{self.name}: ')}"

    def good(self, now_s: float) -> None:
        """It answered well."""
        self.state, self.why, self.good_at_s = "ready", "", now_s

    def troubled(self, why: str) -> None:
        """It is there but answered badly."""
        self.state, self.why = "troubled", why

    def lost(self, why: str) -> None:
        """It is not there, and will be looked for again."""
        self.state, self.why = "waiting", why

    def as_dict(self) -> dict[str, object]:
        """For the API."""
        return {"state": self.state, "why": self.why or None, "good_at_s": self.good_at_s}
