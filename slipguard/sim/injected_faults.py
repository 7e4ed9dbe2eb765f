"""The faults that the simulated devices show now; set by tests and operators, read by the fakes and the world."""

from __future__ import annotations

from slipguard.errors import InputError

_CAMERA = frozenset({"disconnect", "stall", "frozen", "corrupt", "duplicate", "light", "stamps_ahead", "stamps_behind"})
KINDS = {
    "left": _CAMERA,
    "right": _CAMERA,
    "gripper": frozenset({"disconnect", "timeout", "fault", "late", "wrong_echo"}),
    "arm": frozenset({"disconnect", "timeout", "protective_stop", "emergency_stop", "stuck"}),
}
"""Device -> its possible faults."""


class InjectedFaults:
    """Faults on demand. A fault stays until it is repaired; both calls may be repeated."""

    def __init__(self) -> None:
        self._active: dict[str, frozenset[str]] = dict.fromkeys(KINDS, frozenset())

    def fail(self, device: str, kind: str) -> None:
        """Start a fault; raise InputError for an unknown device or kind."""
        self._active[device] = self.active(device) | {_known(device, kind)}

    def repair(self, device: str, kind: str | None = None) -> None:
        """End one fault of a device, or all of them; raise InputError for an unknown device or kind."""
        ended = {_known(device, kind)} if kind is not None else KINDS[_device(device)]
        self._active[device] = self.active(device) - ended

    def active(self, device: str) -> frozenset[str]:
        """Return the present faults of a device; raise InputError for an unknown one."""
        return self._active[_device(device)]


def _device(device: str) -> str:
    if device not in KINDS:
        raise InputError(f"no device {device!r}; there are: {', '.join(KINDS)}")
    return device


def _known(device: str, kind: str) -> str:
    if kind not in KINDS[_device(device)]:
        raise InputError(f"no fault {kind!r} of {device}; there are: {', '.join(sorted(KINDS[device]))}")
    return kind
