"""Drivers by name: whatever registered itself under an entry-point group."""

from __future__ import annotations

from importlib.metadata import entry_points
from typing import Any, Protocol

from pydantic import BaseModel

from slipguard.devices import DriverContext
from slipguard.errors import ConfigError

GROUPS = ("slipguard.tactile", "slipguard.gripper", "slipguard.arm")


class Driver(Protocol):
    """What an entry point must name: a class that owns its section of the configuration."""

    Settings: type[BaseModel]

    def __call__(self, settings: BaseModel, context: DriverContext) -> Any:
        """Build the device; touches no hardware."""
        ...


def driver_names(group: str) -> list[str]:
    """Names registered under `group`, sorted."""
    return sorted(point.name for point in entry_points(group=group))


def load_driver(group: str, name: str) -> Driver:
    """Import one driver. Raises ConfigError naming the alternatives, or the package that is missing."""
    for point in entry_points(group=group):
        if point.name == name:
            try:
                driver: Driver = point.load()
            except ImportError as error:
                raise ConfigError(
                    f"driver {name!r} ({point.value}) cannot be imported: {error}; install the package it needs"
                ) from error
            return driver
    raise ConfigError(
        f"no driver {name!r} is registered under {group}; there are: {', '.join(driver_names(group)) or 'none'}"
    )
