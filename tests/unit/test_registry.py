"""A mistake in a driver of another package is one line that names the driver, not a traceback."""

from __future__ import annotations

from importlib.metadata import EntryPoint
from pathlib import Path

import pytest
from command_line import slipguard

from slipguard import registry

DRIVER = """
from pydantic import BaseModel
from slipguard.devices import Gripper
from slipguard_drivers.robotiq.fake import FakeGripper

class MyGripper(FakeGripper):
    class Settings(BaseModel):
        pass

    def __init__(self, settings, context):
        self.limits = None

    force_limits_n = (10.0, 100.0)
"""
CONFIG = """
left.digit.serial = "D1"
right.digit.serial = "D2"
gripper.driver = "mine"
arm.driver = "none"
guard.mode = "guard"
"""
IMPORTED = "driver 'mine' (my_driver:MyGripper) cannot be imported: "
MISTAKES = [
    ("class MyGripper", "class YourGripper", IMPORTED + "AttributeError: "),
    ("    pass", "    pass)", IMPORTED + "SyntaxError: "),
    ("class Settings(BaseModel)", "class Settings", "has no class Settings, a pydantic model; add it"),
    ("self.limits = None", "1 / 0", "gripper: driver 'mine' cannot be built (my_driver.py, line 11): Zero"),
    ("(FakeGripper)", "(Gripper)", "cannot be built: TypeError: Can't instantiate abstract class MyGripper"),
    ("= (10.0, 100.0)", "= property(lambda self: self.limits[0])", "force_limits_n: TypeError: "),
    ("(10.0, 100.0)", "(100.0, 100.0)", "force_limits_n is 100 to 100 N; the driver must give"),
    ("(10.0, 100.0)", "(10.0, 100.0, 3)", "force_limits_n: ValueError: too many values"),
]


@pytest.mark.parametrize(("before", "after", "expected"), MISTAKES)
def test_a_mistake_in_a_driver_is_one_line(
    before: str,
    after: str,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
) -> None:
    module = f"my_driver_{tmp_path.name}"
    assert DRIVER.count(before) == 1
    (tmp_path / f"{module}.py").write_text(DRIVER.replace(before, after))
    (tmp_path / "config.toml").write_text(CONFIG)
    monkeypatch.syspath_prepend(tmp_path)
    known = registry.entry_points

    def with_mine(*, group: str) -> list[EntryPoint]:
        mine = [EntryPoint("mine", f"{module}:MyGripper", group)] if group == "slipguard.gripper" else []
        return [*known(group=group), *mine]

    monkeypatch.setattr(registry, "entry_points", with_mine)
    ran = slipguard(capfd, "check", "--config", tmp_path / "config.toml")
    assert ran.code == 2
    assert expected in ran.complaint.replace(module, "my_driver")
