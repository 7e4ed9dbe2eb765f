"""Load drivers and emulators by name, from the entry points of installed packages."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any, Protocol

from pydantic import BaseModel

from slipguard.devices import DriverContext
from slipguard.emulator import Emulator, Report
from slipguard.errors import ConfigError, SlipguardError, describe_error, raised_in

GROUPS = ("slipguard.tactile", "slipguard.gripper", "slipguard.arm")
EMULATORS = "slipguard.emulator"
"""The group of the emulators, see `slipguard.emulator`."""


class Driver(Protocol):
    """What the entry point of a driver names: a class with its section of the configuration.

    `Settings` may have `only_one: ClassVar = ("serial",)`: keys whose values must differ between devices.
    """

    Settings: type[BaseModel]

    def __call__(self, settings: BaseModel, context: DriverContext) -> Any:
        """Build the device; opens nothing."""
        ...


class EmulatorKind(Protocol):
    """What the entry point of an emulator names: a class whose settings become command-line options."""

    Settings: type[BaseModel]

    def __call__(self, settings: BaseModel, report: Report | None = None) -> Emulator:
        """Build the emulator; opens nothing."""
        ...


def driver_names(group: str) -> list[str]:
    """Return the names registered under `group`, sorted."""
    return sorted(point.name for point in entry_points(group=group))


def load_driver(group: str, name: str) -> Driver:
    """Import a driver. Raises ConfigError with the alternatives, or with why it cannot be used."""
    driver: Driver = _load(group, name, "driver")
    return driver


def build_device(group: str, name: str, settings: BaseModel, context: DriverContext) -> Any:
    """Build a device with its driver; opens nothing. Raises ConfigError if an error of the driver prevents it."""
    driver = load_driver(group, name)
    try:
        return driver(settings, context)
    except SlipguardError:
        raise
    except Exception as error:
        where = raised_in(error, Path(__file__))
        raise ConfigError(
            f"{context.name}: driver {name!r} cannot be built{where}: {describe_error(error)}; correct the driver"
        ) from error


def load_emulator(name: str) -> EmulatorKind:
    """Import an emulator. Raises ConfigError with the alternatives, or with why it cannot be used."""
    kind: EmulatorKind = _load(EMULATORS, name, "emulator")
    return kind


def _load(group: str, name: str, what: str) -> Any:
    for point in entry_points(group=group):
        if point.name == name:
            try:
                loaded = point.load()
            except ImportError as error:
                raise ConfigError(
                    f"{what} {name!r} ({point.value}) cannot be imported: {error}; install the package it needs"
                ) from error
            except Exception as error:
                reason = f"{describe_error(error)}; correct it, or its entry point"
                raise ConfigError(f"{what} {name!r} ({point.value}) cannot be imported: {reason}") from error
            settings = getattr(loaded, "Settings", None)
            if not (isinstance(settings, type) and issubclass(settings, BaseModel)):
                raise ConfigError(f"{what} {name!r} ({point.value}) has no class Settings, a pydantic model; add it")
            return loaded
    raise ConfigError(
        f"no {what} {name!r} is registered under {group}; there are: {', '.join(driver_names(group)) or 'none'}"
    )
