"""The options of a soak and the configuration that follows from them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from slipguard.config import Config, parse_config
from slipguard.devices import FINGERS

VIRTUAL_LOOP = {"period_ms": 50.0, "poll_ms": 200.0}
"""Longer periods than usual: the allocations per cycle, frame and request are the same."""
RING_S, RING_MAX_MB, KEPT_MAX_MB = 600.0, 100, 50
"""The default ring duration, and sizes so small that both folders reach their limits within hours."""


@dataclass(frozen=True, slots=True)
class SoakSettings:
    """length_s: on the daemon's clock. virtual: virtual clock. page: an operator page is open all the time."""

    length_s: float
    virtual: bool
    seed: int = 0
    page: bool = False
    recording: bool = True

    @property
    def fps(self) -> float:
        """A quarter of the cameras' rate on the virtual clock: processing a frame takes the same real time."""
        return 15.0 if self.virtual else 60.0


def soak_config(settings: SoakSettings, folder: Path) -> Config:
    """Return a configuration with the fakes, defaults, and recording limits small enough to be reached."""
    draw = "background" if settings.virtual else "process"
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": draw}} for name in FINGERS}
    raw["guard"] = {"lift_height_mm": 100.0, "lift_speed_mm_s": 80.0, "tuning": {"lower_speed_mm_s": 150.0}}
    raw["loop"] = VIRTUAL_LOOP if settings.virtual else {}
    raw["state"] = {"directory": str(folder)}
    raw["api"] = {"listen": ""}
    raw["recording"] = {
        "enabled": settings.recording,
        "ring_s": RING_S,
        "ring_max_mb": RING_MAX_MB,
        "kept_max_mb": KEPT_MAX_MB,
    }
    return parse_config(raw, where="soak", sim=True)
