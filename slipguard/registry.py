"""Drivers by name: whatever registered itself under an entry-point group."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any, Protocol

from pydantic import BaseModel

from slipguard.devices import DriverContext
from slipguard.emulator import Emulator, Report
from slipguard.errors import ConfigError

GROUPS = ("slipguard.tactile", "slipguard.gripper", "slipguard.arm")
EMULATORS = "slipguard.emulator"
"""The group of the doubles on the wire, see `slipguard.emulator`."""


class Driver(Protocol):
    """What an entry point must name: a class that owns its section of the configuration.

    `Settings` may have `only_one: ClassVar = ("serial",)`: keys whose value only one device can have.
    """

    Settings: type[BaseModel]

    def __call__(self, settings: BaseModel, context: DriverContext) -> Any:
        """Build the device; touches no hardware."""
        ...


class EmulatorKind(Protocol):
    """What an entry point of `slipguard.emulator` must name: a class whose settings become options."""

    Settings: type[BaseModel]

    def __call__(self, settings: BaseModel, report: Report | None = None) -> Emulator:
        """Build the emulator; opens nothing."""
        ...


def driver_names(group: str) -> list[str]:
    """Names registered under `group`, sorted."""
    return sorted(point.name for point in entry_points(group=group))


def load_driver(group: str, name: str) -> Driver:
    """Import one driver. Raises ConfigError naming the alternatives, or the package that is missing."""
    driver: Driver = _load(group, name, "driver")
    return driver


def load_emulator(name: str) -> EmulatorKind:
    """Import one emulator. Raises ConfigError naming the alternatives, or the package that is missing."""
    kind: EmulatorKind = _load(EMULATORS, name, "emulator")
    return kind


def _load(group: str, name: str, what: str) -> Any:
    for point in entry_points(group=group):
        if point.name == name:
            try:
                return point.load()
            except ImportError as error:
                raise ConfigError(
                    f"{what} {name!r} ({point.value}) cannot be imported: {error}; install the package it needs"
                ) from error
    raise ConfigError(
        f"no {what} {name!r} is registered under {group}; there are: {', '.join(driver_names(group)) or 'none'}"
    )
