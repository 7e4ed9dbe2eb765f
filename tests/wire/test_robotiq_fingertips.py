"""The real driver and sensors on the fingers: true widths, and a limit that keeps the gels apart."""

from __future__ import annotations

from collections.abc import AsyncIterator
from pathlib import Path

import pytest
from pydantic import ValidationError
from robotiq_rig import each_model, put, quick, settings, until_it_rests

from slipguard.devices import DriverContext
from slipguard.errors import CommandRefused
from slipguard_drivers.robotiq.gripper import RobotiqGripper
from slipguard_drivers.robotiq.registers import MODELS
from slipguard_emulators.robotiq.emulator import RobotiqEmulator

TIP_MM = 20.0


@pytest.fixture
async def emulator(request: pytest.FixtureRequest, tmp_path: Path) -> AsyncIterator[RobotiqEmulator]:
    model = getattr(request, "param", "2F-85")
    emulator = quick(tmp_path, activated=True, fingertip_mm=TIP_MM, model=model)
    await emulator.start()
    yield emulator
    await emulator.stop()


async def driver(emulator: RobotiqEmulator, fingertip_mm: float) -> RobotiqGripper:
    options = settings(emulator).model_copy(update={"fingertip_mm": fingertip_mm})
    gripper = RobotiqGripper(options, DriverContext("gripper"))
    await gripper.open()
    return gripper


async def closed(gripper: RobotiqGripper, force_n: float = 130.0) -> tuple[bool, bool]:
    """Whether it holds something, and whether it has closed on nothing."""
    await gripper.hold(force_n)
    await until_it_rests(gripper)
    state = await gripper.state()
    return state.holding, state.closed_on_nothing


async def test_without_the_setting_gel_on_gel_is_a_held_object(emulator: RobotiqEmulator) -> None:
    gripper = await driver(emulator, 0.0)
    assert await closed(gripper) == (True, False)
    assert float(str(emulator.state()["force_n"])) > 100.0
    await gripper.close()


@each_model
@pytest.mark.parametrize("configured_mm", [TIP_MM, TIP_MM + 0.4, TIP_MM - 0.4])
async def test_closing_on_nothing_ends_before_the_gels_meet(emulator: RobotiqEmulator, configured_mm: float) -> None:
    gripper = await driver(emulator, configured_mm)
    assert await closed(gripper) == (False, True)
    assert emulator.state()["force_n"] == 0.0
    assert float(str(emulator.state()["width_mm"])) > 2 * TIP_MM
    opening_mm = MODELS[emulator.settings.model].stroke_mm - 2 * configured_mm
    assert await gripper.move(30.0, 20.0) == pytest.approx(min(30.0, opening_mm), abs=0.2)
    await gripper.close()


async def test_gels_that_meet_nevertheless_are_no_object(emulator: RobotiqEmulator) -> None:
    gripper = await driver(emulator, TIP_MM - 0.7)
    assert await closed(gripper) == (False, True)
    assert await gripper.move(30.0, 20.0) > 29.0, "nothing is held"
    await gripper.close()


async def test_widths_are_those_between_the_gels(emulator: RobotiqEmulator) -> None:
    gripper = await driver(emulator, TIP_MM)
    assert (await gripper.state()).width_mm == pytest.approx(85.0 - 2 * TIP_MM, abs=0.2)
    put(emulator, 12.0)
    assert await closed(gripper) == (True, False)
    assert (await gripper.state()).width_mm == pytest.approx(12.0, abs=0.4)
    with pytest.raises(CommandRefused, match="opens 0 to 45 mm"):
        await gripper.move(-1.0, 20.0)
    await gripper.release(1000.0)
    await until_it_rests(gripper)
    assert emulator.state()["width_mm"] == 85.0
    await gripper.close()


async def test_a_lost_object_does_not_let_the_gels_meet(emulator: RobotiqEmulator) -> None:
    gripper = await driver(emulator, TIP_MM)
    put(emulator, 12.0)
    assert await closed(gripper) == (True, False)
    put(emulator, None)
    assert await closed(gripper, 200.0) == (False, True), "tightened at the same moment"
    assert emulator.state()["force_n"] == 0.0
    assert float(str(emulator.state()["width_mm"])) > 2 * TIP_MM
    await gripper.close()


def test_sensors_that_leave_no_opening_are_refused() -> None:
    with pytest.raises(ValidationError, match=r"leaves no opening on a Hand-E: it must be at most 22\.5"):
        RobotiqGripper.Settings(port="tty", model="Hand-E", fingertip_mm=25.0)


async def test_the_doctor_says_so(emulator: RobotiqEmulator) -> None:
    for fingertip_mm, status, words in ((0.0, "note", "looks like a held object"), (20.0, "ok", "open to 45 mm")):
        gripper = RobotiqGripper(
            settings(emulator).model_copy(update={"fingertip_mm": fingertip_mm}), DriverContext("gripper")
        )
        found = {one.check: one async for one in gripper.diagnose(owned=False)}
        assert found["fingertips"].status == status
        assert words in found["fingertips"].observed


async def test_a_limit_set_while_an_object_is_held_does_not_open_the_jaws(emulator: RobotiqEmulator) -> None:
    gripper = await driver(emulator, 0.0)
    put(emulator, 3.0)
    assert await closed(gripper) == (True, False)
    width_mm = float(str(emulator.state()["width_mm"]))
    await gripper.close()
    gripper = await driver(emulator, TIP_MM + 4.0)
    await gripper.hold(130.0)
    await until_it_rests(gripper)
    assert float(str(emulator.state()["width_mm"])) == pytest.approx(width_mm, abs=0.2)
    await gripper.close()
