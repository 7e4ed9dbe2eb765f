"""The UR driver where ur-rtde is not installed: lift mode says what to do, guard mode works."""

from __future__ import annotations

import importlib.util

import pytest

from slipguard.devices import DriverContext
from slipguard.errors import ConfigError
from slipguard_drivers.ur5.arm import Ur5Arm
from slipguard_drivers.ur5.settings import Ur5Settings

SETTINGS = Ur5Settings(host="127.0.0.1")


def _not_found(name: str) -> None:
    return None


def _blocked(name: str) -> None:
    raise ImportError(f"{name} is blocked")


@pytest.mark.parametrize("find_spec", [_not_found, _blocked])
def test_lift_mode_names_the_python_versions_and_the_alternative(
    monkeypatch: pytest.MonkeyPatch, find_spec: object
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", find_spec)
    with pytest.raises(ConfigError, match=r'Python 3\.11 or 3\.12, or set \[guard\] mode = "guard"'):
        Ur5Arm(SETTINGS, DriverContext("arm", mode="lift"))


def test_guard_mode_is_built_without_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", _not_found)
    Ur5Arm(SETTINGS, DriverContext("arm", mode="guard"))
