"""Every registered driver loads, keeps its whole port, and refuses settings it does not know."""

from __future__ import annotations

import tomllib
from importlib.metadata import EntryPoint, entry_points

import pytest
from pydantic import BaseModel, ValidationError
from sandbox import ROOT

from slipguard.devices import Arm, Gripper, TactileSensor
from slipguard.emulator import Emulator
from slipguard.registry import EMULATORS, GROUPS, driver_names

PORTS = {"slipguard.tactile": TactileSensor, "slipguard.gripper": Gripper, "slipguard.arm": Arm, EMULATORS: Emulator}
POINTS = [point for group in PORTS for point in entry_points(group=group)]
each_driver = pytest.mark.parametrize("point", POINTS, ids=lambda point: f"{point.group}: {point.name}")


def test_what_is_registered_is_what_the_project_says() -> None:
    declared = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"]
    assert set(declared) == {*GROUPS, EMULATORS} == set(PORTS)
    for group in PORTS:
        assert set(declared[group]) <= set(driver_names(group))
    for group in GROUPS:
        assert "fake" in declared[group]


@each_driver
def test_it_keeps_its_whole_port(point: EntryPoint) -> None:
    driver = point.load()
    port = PORTS[point.group]
    assert port in driver.__mro__
    assert not driver.__abstractmethods__
    for name in port.__abstractmethods__:
        assert getattr(driver, name).__doc__ or getattr(port, name).__doc__


@each_driver
def test_its_settings_refuse_what_they_do_not_know(point: EntryPoint) -> None:
    settings = point.load().Settings
    assert issubclass(settings, BaseModel)
    with pytest.raises(ValidationError) as caught:
        settings.model_validate({"no_such_key": 1})
    problems = {problem["loc"]: problem["type"] for problem in caught.value.errors()}
    assert problems.pop(("no_such_key",)) == "extra_forbidden"
    assert set(problems.values()) <= {"missing"}
    assert settings.model_config.get("frozen")
