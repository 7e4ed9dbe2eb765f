"""Says of each device when it is not well, and when it is again: in every phase, and once."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Protocol

from slipguard.control.messages import Condition, FingerHealth, Observation, without_figures
from slipguard.control.state import AT_STAKE, Phase
from slipguard.daemon.loop.health import NOT_TRIED, Health

LASTS_S = 0.15
"""Trouble is said when it has lasted so long, ..."""
TIMES = 3
OFTEN_S = 1.0
"""... or has begun so many times within this time."""
AGAIN_S = 0.3
"""Another trouble of a device is said no sooner after the last line on it."""
WELL_S = 0.5
"""A device that has been well for so long is well again."""
START_S = 2.0
"""A device that has said nothing yet, good or bad, may take so long before it is said."""
SLOW_S = 0.15
"""Gripper and arm are asked every 25 ms; an answer older than this is late."""


class Device(Protocol):
    """A finger or an actuator."""

    @property
    def health(self) -> Health: ...


def troubles(observation: Observation, devices: Mapping[str, Device]) -> dict[str, str | None]:
    """By device what is wrong with it now, in words; None where nothing is."""
    found: dict[str, str | None] = {
        name: None if device.health.ready else device.health.reason for name, device in devices.items()
    }
    for name, finger in (("left", observation.left), ("right", observation.right)):
        found[name] = found[name] or _stale(finger)
    if observation.gripper is not None:
        says = None if observation.gripper.fault is None else f"says: {observation.gripper.fault}"
        found["gripper"] = found["gripper"] or says or _late(observation.now_s - observation.gripper.measured_at_s)
    if observation.arm is not None:
        stops = (("emergency", observation.arm.emergency_stop), ("protective", observation.arm.protective_stop))
        says = next((f"in {kind} stop" for kind, stopped in stops if stopped), None)
        found["arm"] = found["arm"] or says or _late(observation.now_s - observation.arm.measured_at_s)
    return found


def _stale(finger: FingerHealth) -> str | None:
    if finger.condition is Condition.FRESH or not math.isfinite(finger.age_s):
        return None
    how = "old" if finger.age_s > 0.0 else "ahead of the clock"
    return f"its newest frame is {abs(finger.age_s):.2f} s {how}"


def _late(age_s: float) -> str | None:
    return f"its newest answer is {age_s:.2f} s old" if age_s > SLOW_S else None


@dataclass(slots=True)
class _Told:
    """What is remembered of one device. well_s: since when it is well; began: when its latest troubles began."""

    since_s: float | None = None
    well_s: float | None = None
    began: list[float] = field(default_factory=list)
    kind: str | None = None
    told: str | None = None
    told_s: float = -math.inf
    known_well: bool = False


class DeviceAlerts:
    """say, warn: take one line; what goes well again is said, all else is warned of. One for each service."""

    def __init__(self, say: Callable[[str], None], warn: Callable[[str], None]) -> None:
        self._say, self._warn = say, warn
        self._devices: dict[str, _Told] = {}
        self._first_s: float | None = None
        self._last_s: float | None = None

    def look(self, now_s: float, troubles: Mapping[str, str | None], phase: Phase, late_s: float) -> None:
        """To be called every turn of the loop. late_s: nothing decided for so long is said where the law does not."""
        self._first_s = now_s if self._first_s is None else self._first_s
        since_s = 0.0 if self._last_s is None else now_s - self._last_s
        if since_s >= late_s and phase not in AT_STAKE and phase is not Phase.FAULT:
            self._warn(f"loop: nothing was decided for {since_s:.2f} s; see what keeps the machine busy")
        self._last_s = now_s
        for name, why in troubles.items():
            device = self._devices.setdefault(name, _Told())
            if why is None:
                self._well(name, device, now_s)
            else:
                self._troubled(name, device, why, now_s)

    def _well(self, name: str, device: _Told, now_s: float) -> None:
        device.since_s = device.kind = None
        device.well_s = now_s if device.well_s is None else device.well_s
        if now_s - device.well_s < WELL_S and device.known_well:
            return
        if device.told is not None:
            self._say(f"{name}: well again")
        device.known_well, device.told = True, None

    def _troubled(self, name: str, device: _Told, why: str, now_s: float) -> None:
        kind = without_figures(why)
        if device.since_s is None or device.kind != kind:
            device.since_s, device.kind = now_s, kind
            device.began = [began_s for began_s in device.began if now_s - began_s < OFTEN_S] + [now_s]
        device.well_s = None
        starts = why == NOT_TRIED and now_s - (self._first_s or now_s) < START_S
        lasts = now_s - device.since_s >= LASTS_S or len(device.began) >= TIMES
        if kind != device.told and lasts and not starts and now_s - device.told_s >= AGAIN_S:
            device.told, device.told_s = kind, now_s
            self._warn(why if why.startswith(f"{name}: ") else f"{name}: {why}")
