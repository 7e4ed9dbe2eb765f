"""Whether each device works, and one log line when one stops working or recovers."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal, Protocol

from slipguard.control.messages import Condition, Observation, without_figures
from slipguard.control.state import AT_STAKE, Phase

NOT_TRIED = "not tried yet"
CONFIRM_S = 0.15
"""A problem is logged once it has lasted this long, ..."""
REPEATS = 3
REPEATS_WITHIN_S = 1.0
"""... or has begun `REPEATS` times within this time."""
ALERT_INTERVAL_S = 0.3
"""Shortest time between two alerts about one device."""
RECOVERED_S = 0.5
"""A device that has worked for this long has recovered."""
START_S = 2.0
"""Time after the start before a device that was not tried yet is logged."""
SLOW_S = 0.15
"""Gripper and arm are polled every 25 ms; an older response is late."""


@dataclass(slots=True)
class Health:
    """One device's health; written by the task that talks to the device.

    state: `disconnected` (never connected or lost; being retried), `error` (connected, but its last response was
    bad), `ready`. reason: why it is not ready, without the device's name.
    """

    name: str
    state: Literal["ready", "error", "disconnected"] = "disconnected"
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
        return f"{self.name}: {self.reason}"

    def set_ready(self, now_s: float) -> None:
        """Note a good response."""
        self.state, self.reason, self.last_ready_at_s = "ready", "", now_s

    def set_error(self, reason: str) -> None:
        """Note a bad response of a connected device."""
        self.state, self.reason = "error", self._without_name(reason)

    def set_disconnected(self, reason: str) -> None:
        """Note that the device is gone and will be retried."""
        self.state, self.reason = "disconnected", self._without_name(reason)

    def _without_name(self, reason: str) -> str:
        return reason.removeprefix(f"{self.name}: ")


class HasHealth(Protocol):
    """A finger or an actuator."""

    @property
    def health(self) -> Health: ...


def find_problems(observation: Observation, devices: Mapping[str, HasHealth]) -> dict[str, str | None]:
    """Return by device what is wrong with it now, in words; None if nothing is."""
    found: dict[str, str | None] = {
        name: None if device.health.ready else device.health.reason for name, device in devices.items()
    }
    for name, finger in (("left", observation.left), ("right", observation.right)):
        if finger.condition is not Condition.FRESH and math.isfinite(finger.age_s):
            found[name] = found[name] or finger.why
    now_s, gripper, arm = observation.now_s, observation.gripper, observation.arm
    if gripper is not None:
        reported = None if gripper.fault is None else f"reports: {gripper.fault}"
        found["gripper"] = found["gripper"] or reported or _late_response(now_s - gripper.measured_at_s)
    if arm is not None:
        stops = (("emergency", arm.emergency_stop), ("protective", arm.protective_stop))
        reported = next((f"in {kind} stop" for kind, stopped in stops if stopped), None)
        found["arm"] = found["arm"] or reported or _late_response(now_s - arm.measured_at_s)
    return found


def _late_response(age_s: float) -> str | None:
    return f"its newest response is {age_s:.2f} s old" if age_s > SLOW_S else None


@dataclass(slots=True)
class _AlertState:
    """One device's problem and the last alert about it. Kinds are texts without their figures."""

    problem_since_s: float | None = None
    working_since_s: float | None = None
    onsets_s: list[float] = field(default_factory=list)
    """When its latest problems began."""
    problem_kind: str | None = None
    alerted_kind: str | None = None
    alerted_s: float = -math.inf
    has_worked: bool = False


class DeviceAlerts:
    """Logs a device's problem once, and once that it works again. One per service.

    Args:
        info: Receives one line for each recovery.
        warning: Receives one line for each problem.
    """

    def __init__(self, info: Callable[[str], None], warning: Callable[[str], None]) -> None:
        self._info, self._warning = info, warning
        self._devices: dict[str, _AlertState] = {}
        self._first_s: float | None = None
        self._last_s: float | None = None

    def update(self, now_s: float, problems: Mapping[str, str | None], phase: Phase, late_s: float) -> None:
        """Check all devices; to be called in every cycle of the loop.

        Args:
            now_s: Loop time of this cycle.
            problems: What `find_problems` returned.
            phase: Phase of the grasp.
            late_s: A longer gap between two cycles is logged in the phases in which the controller does not report it.
        """
        self._first_s = now_s if self._first_s is None else self._first_s
        since_s = 0.0 if self._last_s is None else now_s - self._last_s
        if since_s >= late_s and phase not in AT_STAKE and phase is not Phase.FAULT:
            self._warning(
                f"loop: no control step for {since_s:.2f} s (limit {late_s:g} s); check what keeps the machine busy"
            )
        self._last_s = now_s
        for name, reason in problems.items():
            device = self._devices.setdefault(name, _AlertState())
            if reason is None:
                self._working(name, device, now_s)
            else:
                self._failing(name, device, reason, now_s)

    def _working(self, name: str, device: _AlertState, now_s: float) -> None:
        device.problem_since_s = device.problem_kind = None
        device.working_since_s = now_s if device.working_since_s is None else device.working_since_s
        if now_s - device.working_since_s < RECOVERED_S and device.has_worked:
            return
        if device.alerted_kind is not None:
            self._info(f"{name}: works again")
        device.has_worked, device.alerted_kind = True, None

    def _failing(self, name: str, device: _AlertState, reason: str, now_s: float) -> None:
        kind = without_figures(reason)
        if device.problem_since_s is None or device.problem_kind != kind:
            device.problem_since_s, device.problem_kind = now_s, kind
            device.onsets_s = [onset_s for onset_s in device.onsets_s if now_s - onset_s < REPEATS_WITHIN_S] + [now_s]
        device.working_since_s = None
        starting = reason == NOT_TRIED and now_s - (self._first_s or now_s) < START_S
        confirmed = now_s - device.problem_since_s >= CONFIRM_S or len(device.onsets_s) >= REPEATS
        due = now_s - device.alerted_s >= ALERT_INTERVAL_S
        if kind != device.alerted_kind and confirmed and not starting and due:
            device.alerted_kind, device.alerted_s = kind, now_s
            self._warning(reason if reason.startswith(f"{name}: ") else f"{name}: {reason}")
