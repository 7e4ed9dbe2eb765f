"""Which simulated devices fail at the moment, and how: set by a test or a person, read by fakes and world."""

from __future__ import annotations

from slipguard.errors import InputError

_CAMERA = frozenset({"disconnect", "stall", "frozen", "corrupt", "duplicate", "light", "stamps_ahead", "stamps_behind"})
KINDS = {
    "left": _CAMERA,
    "right": _CAMERA,
    "gripper": frozenset({"disconnect", "timeout", "fault", "late", "wrong_echo"}),
    "arm": frozenset({"disconnect", "timeout", "protective_stop", "emergency_stop", "stuck"}),
}
"""Device -> the ways it can fail."""


class InjectedFaults:
    """Faults on demand. A fault stays until it is mended; setting or mending twice does no harm."""

    def __init__(self) -> None:
        self._active: dict[str, frozenset[str]] = dict.fromkeys(KINDS, frozenset())

    def fail(self, device: str, kind: str) -> None:
        """Let `device` fail; raises InputError for a device or kind that does not exist."""
        self._active[device] = self.active(device) | {_known(device, kind)}

    def repair(self, device: str, kind: str | None = None) -> None:
        """End one fault of `device`, or all of them; raises InputError like `fail`."""
        gone = {_known(device, kind)} if kind is not None else KINDS[_device(device)]
        self._active[device] = self.active(device) - gone

    def active(self, device: str) -> frozenset[str]:
        """The faults `device` has now; raises InputError for an unknown device."""
        return self._active[_device(device)]


def _device(device: str) -> str:
    if device not in KINDS:
        raise InputError(f"no device {device!r}; there are {', '.join(KINDS)}")
    return device


def _known(device: str, kind: str) -> str:
    if kind not in KINDS[_device(device)]:
        raise InputError(f"{device} cannot fail by {kind!r}; it can by {', '.join(sorted(KINDS[device]))}")
    return kind
