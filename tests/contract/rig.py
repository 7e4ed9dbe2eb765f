"""Common to all rigs of the contract suites: which of them a test can use, and drivers of other packages."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, TypeVar

import pytest

from slipguard.devices import DriverContext
from slipguard.registry import load_driver

Test = TypeVar("Test", bound=Callable[..., Any])
GROUPS = {"sensor": "slipguard.tactile", "gripper": "slipguard.gripper", "arm": "slipguard.arm"}
HARDWARE = ("real", "driver")


def needs(*abilities: str) -> Callable[[Test], Test]:
    """Run a test only on rigs with these abilities, such as "faults"; a rig without them is not even a parameter."""

    def mark(test: Test) -> Test:
        test.needs = set(abilities)  # type: ignore[attr-defined]
        return test

    return mark


def parametrize_rig(
    metafunc: pytest.Metafunc, abilities: Mapping[str, set[str]], fixture_needs: Mapping[str, str] | None = None
) -> None:
    """Run the test on every kind of rig that has what it needs.

    Args:
        abilities: what each kind of rig can do.
        fixture_needs: what a test needs because it uses a fixture.
    """
    if "rig" in metafunc.fixturenames:
        wanted: set[str] = set(getattr(metafunc.function, "needs", ()))
        wanted |= {need for fixture, need in (fixture_needs or {}).items() if fixture in metafunc.fixturenames}
        metafunc.parametrize("rig", [kind for kind, has in abilities.items() if wanted <= has], indirect=True)


def hardware_kinds(config: pytest.Config, device: str, real_option: str) -> list[str]:
    """Return `real` if a device is named, and `driver` if a driver of another package is."""
    named = (config.getoption(real_option), config.getoption(f"--{device}-driver"))
    return [kind for kind, name in zip(HARDWARE, named, strict=True) if name]


def named_driver(config: pytest.Config, device: str, context: DriverContext) -> Any:
    """Return the device of `--DEVICE-driver`, built with `--DEVICE-settings`; it is not opened."""
    driver = load_driver(GROUPS[device], config.getoption(f"--{device}-driver"))
    return driver(driver.Settings.model_validate_json(config.getoption(f"--{device}-settings")), context)
