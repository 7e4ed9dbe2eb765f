"""The parts of the emulated cell: the world behind registers, the robot's own program, the configuration, the truth."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slipguard.config import read_config
from slipguard.errors import CommandRefused, InputError
from slipguard.sim.gripper_plant import GripperDynamics
from slipguard.sim.scenario import Scenario
from slipguard.sim.world import World, WorldSettings
from slipguard_emulators.cell.cell_config import MARK, CellPaths, config_text
from slipguard_emulators.cell.emulator import CellEmulator, CellWorld
from slipguard_emulators.cell.lift_program import LiftProgram, LiftStage
from slipguard_emulators.cell.truth_log import line_of
from slipguard_emulators.cell.world_jaws import WorldJaws
from slipguard_emulators.robotiq.registers import ActivationStage
from slipguard_emulators.ur5.tool import WorldTool

QUICK = GripperDynamics(transaction_s=0.0, dead_time_s=0.02, ramp_n_s=200.0, speed_mm_s=150.0)


@pytest.fixture
def world() -> World:
    """Jaws around a wrench that they do not touch yet, at time 0."""
    world = World(WorldSettings(gripper=QUICK))
    world.place(Scenario("wrench", gripper=QUICK), 0.0)
    return world


def test_the_jaws_close_on_the_object_and_tighten(world: World) -> None:
    jaws = WorldJaws(world)
    jaws.drive(0.0, 0.0, 150.0, 40.0)
    assert jaws.state_at(0.1).moving
    held = jaws.state_at(3.0)
    assert held.met_closing
    assert held.holds
    assert held.force_n == pytest.approx(40.0, abs=0.9)
    jaws.halt(3.0)
    assert jaws.state_at(3.1) == held, "a motor at rest cannot be stopped"
    jaws.drive(3.1, 0.0, 150.0, 80.0)
    assert jaws.state_at(5.0).force_n == pytest.approx(80.0, abs=0.9)
    jaws.drive(5.0, 0.0, 150.0, 30.0)
    assert jaws.state_at(6.0).force_n == pytest.approx(80.0, abs=0.9), "the screw loosens nothing"


def test_a_halt_keeps_the_force_and_a_drive_continues_from_it(world: World) -> None:
    jaws = WorldJaws(world)
    jaws.drive(0.0, 0.0, 150.0, 40.0)
    jaws.state_at(3.0)
    jaws.drive(3.0, 0.0, 150.0, 120.0)
    jaws.halt(3.2)
    stopped = jaws.state_at(4.0)
    assert 60.0 < stopped.force_n < 90.0
    assert not stopped.moving
    jaws.drive(4.0, 0.0, 150.0, 120.0)
    assert jaws.state_at(6.0).force_n == pytest.approx(120.0, abs=0.9)


def test_the_jaws_open_fully(world: World) -> None:
    jaws = WorldJaws(world)
    jaws.drive(0.0, 0.0, 150.0, 40.0)
    jaws.state_at(3.0)
    jaws.drive(3.0, 85.0, 150.0, 20.0)
    opened = jaws.state_at(6.0)
    assert (opened.width_mm, opened.holds) == (85.0, False)


def test_the_robots_program_lifts_and_continues_after_a_pause() -> None:
    world, held = World(), False
    tool = WorldTool(world)
    program = LiftProgram(tool, lambda: held, height_m=0.1, speed_m_s=0.1, wait_s=1.0, stay_s=0.5)
    low = tool.pose(0.0)[2]
    stages, now_s, paused = [], 0.0, False
    while now_s < 12.0:
        now_s += 0.008
        held = 1.0 < now_s < 10.0
        if not paused and program.stage is LiftStage.UP and tool.pose(now_s)[2] > low + 0.05:
            program.pause(now_s)
            paused = True
            stopped_at = tool.pose(now_s + 1.0)[2]
            assert stopped_at < low + 0.06
            now_s += 1.0
            program.resume(now_s)
        assert program.cycle(now_s) is None
        if not stages or stages[-1] is not program.stage:
            stages.append(program.stage)
    assert stages == [
        LiftStage.WAITING,
        LiftStage.UP,
        LiftStage.STAYING,
        LiftStage.DOWN,
        LiftStage.DONE,
        LiftStage.WAITING,
    ]
    assert tool.pose(now_s)[2] == pytest.approx(low, abs=1e-6)


@pytest.mark.parametrize("mode", ["lift", "guard"])
def test_the_configuration_is_one_that_slipguard_reads(tmp_path: Path, mode: str) -> None:
    places = CellPaths(tmp_path)
    gripper = {"urcap": "127.0.0.9:63352"} if mode == "guard" else {"port": "/dev/ttyUSB0"}
    text = config_text(places, gripper=gripper, mode=mode, host="127.0.0.9", height_mm=80.0, speed_mm_s=50.0)  # type: ignore[arg-type]
    places.config.write_text(text)
    config = read_config(places.config)
    assert (config.guard.mode, config.guard.lift_height_mm) == (mode, 80.0)
    assert config.left.driver == "socket"
    assert config.gripper.settings.model_dump().items() >= gripper.items()
    assert config.api.socket == places.api


def test_another_configuration_is_not_replaced(tmp_path: Path) -> None:
    (tmp_path / "config.toml").write_text("[left]\n")
    with pytest.raises(InputError, match="another folder"):
        CellPaths(tmp_path).make()
    (tmp_path / "config.toml").write_text(MARK)
    CellPaths(tmp_path).make()
    with pytest.raises(InputError, match="longer"):
        CellPaths(tmp_path / ("x" * 120)).make()


def test_a_line_of_truth_is_json_with_plain_names(world: World) -> None:
    line = json.loads(json.dumps(line_of(world.truth(0.5))))
    assert {"t", "rotation", "slip", "force", "needed", "height", "dropped"} <= set(line)
    assert line["dropped"] is None
    assert line["needed"] > 0.0


def test_the_cameras_run_at_the_rate_asked_for() -> None:
    assert CellWorld(3, 30.0).camera("left").fps == 30.0


@pytest.mark.parametrize("activated", [False, True])
async def test_the_gripper_starts_as_after_power_on_unless_chosen_otherwise(activated: bool, tmp_path: Path) -> None:
    options = {"activated": True} if activated else {}
    cell = CellEmulator(CellEmulator.Settings.model_validate({"folder": tmp_path / "cell", **options}))
    cell.places.make()
    await cell.gripper.start()
    assert (cell.gripper.registers.stage is ActivationStage.READY) is activated
    await cell.gripper.stop()


@pytest.mark.parametrize(("power", "lost"), [("own", 0), ("wrist", 1)])
async def test_power_from_the_wrist_is_off_in_an_emergency_stop(power: str, lost: int, tmp_path: Path) -> None:
    options = {"folder": tmp_path / "cell", "gripper_power": power, "activated": True, "robot_on": True}
    cell = CellEmulator(CellEmulator.Settings.model_validate(options))
    cell.places.make()
    await cell.gripper.start()
    cell._power_gripper()
    assert cell.gripper.registers.stage is ActivationStage.READY
    cell.control("fault arm.emergency_stop")
    assert len(cell.gripper.events("power lost")) == lost
    assert cell.gripper.faults.lasts("power") is bool(lost)
    cell.control("clear arm.emergency_stop")
    assert not cell.gripper.faults.lasts("power")
    assert (cell.gripper.registers.stage is ActivationStage.OFF) is bool(lost)
    await cell.gripper.stop()


async def test_faults_start_with_the_name_of_their_part(tmp_path: Path) -> None:
    """Set before its start as well, when there is no folder for a port yet."""
    cell = CellEmulator(CellEmulator.Settings(folder=tmp_path / "cell"))
    assert "until cleared" in cell.control("fault left.stall")
    assert "0.01" in cell.control("fault gripper.late 0.01")
    cell.control("fault arm.freeze 3")
    assert set(str(cell.state()["faults"]).split(", ")) == {"left.stall", "gripper.late", "arm.freeze"}
    cell.control("clear left.stall")
    assert cell.world.faults.active("left") == frozenset()
    for words in (
        "fault left.stall 0.5",
        "fault left.tear 3",
        "fault late",
        "fault left.late",
        "place",
        "place mug",
        "clear x",
        "nonsense",
    ):
        with pytest.raises(CommandRefused):
            cell.control(words)
    cell.control("clear gripper.late")
    cell.control("fault right.tear 0.05")
    assert cell.world.camera("right").tear_probability == 0.05
    assert "right.tear" in str(cell.state()["faults"])
    cell.control("clear right.tear")
    assert cell.world.camera("right").tear_probability == 0.0
    assert str(cell.state()["faults"]) == "arm.freeze"
    cell.control("place key 2")
    assert cell.state()["object"] == "key"
    cell.control("take")
    assert cell.state()["object"] is None
    for camera in cell.cameras.values():
        await camera.close()
