"""The emulated controller from the inside: its dashboard's answers, its programs, its tools, its control words."""

from __future__ import annotations

import asyncio
import math
import os

import pytest

from slipguard.errors import CommandRefused, InputError
from slipguard.sim.world import World
from slipguard_emulators.ur5.controller import PAUSED, PLAYING, STOPPED, EmulatedController
from slipguard_emulators.ur5.dashboard import DashboardServer
from slipguard_emulators.ur5.emulator import UrEmulator
from slipguard_emulators.ur5.tool import START_POSE, StraightTool, WorldTool

E_SERIES, CB3 = (5, 17, 3, 0), (3, 15, 8, 0)
HOST = f"127.{20 + os.getpid() // 256 % 200}.{os.getpid() % 256}.35"
"""Of this run of the tests alone: the ports cannot be chosen."""


class Log(list[str]):
    """The events of a controller."""

    def __call__(self, event: str, **details: object) -> None:
        self.append(event)


def test_the_dashboard_answers_as_a_real_one_does() -> None:
    controller = EmulatedController(StraightTool(), Log())
    dashboard = DashboardServer(controller, E_SERIES)
    talk = (
        ("PolyscopeVersion", "URSoftware 5.17.3.0 (Nov 01 2024)"),
        ("get serial number", "20225500001"),
        ("is in remote control", "true"),
        ("robotmode", "Robotmode: RUNNING"),
        ("safetystatus", "Safetystatus: NORMAL"),
        ("programState", "STOPPED shuttle.urp"),
        ("pause", "Failed to execute: pause"),
        ("play", "Starting program"),
        ("running", "Program running: true"),
        ("programState", "PLAYING shuttle.urp"),
        ("pause", "Pausing program"),
        ("programState", "PAUSED shuttle.urp"),
        ("play", "Starting program"),
        ("stop", "Stopped"),
        ("running", "Program running: false"),
        ("make tea", "could not understand: 'make tea'"),
        ("quit", "Disconnected"),
    )
    for number, (asked, answer) in enumerate(talk):
        assert dashboard.answer(asked, float(number)) == answer
    assert DashboardServer(controller, CB3).answer("is in remote control", 20.0).startswith("could not understand")


def test_a_connection_made_in_local_control_stays_refused() -> None:
    controller = EmulatedController(StraightTool(), Log())
    controller.remote = False
    dashboard = DashboardServer(controller, E_SERIES)
    assert dashboard.answer("is in remote control", 0.0) == "false"
    assert dashboard.answer("play", 0.0).startswith("Command is not allowed")
    controller.remote = True
    assert dashboard.answer("play", 0.0).startswith("Command is not allowed")
    assert DashboardServer(controller, E_SERIES).answer("play", 0.0) == "Starting program"


def test_a_robot_starts_switched_off_and_in_local_control() -> None:
    controller = EmulatedController(StraightTool(), Log(), ready=False)
    for asked, answer in (("robotmode", "Robotmode: POWER_OFF"), ("is in remote control", "false")):
        assert DashboardServer(controller, E_SERIES).answer(asked, 0.0) == answer
    assert DashboardServer(controller, E_SERIES).answer("power on", 0.0).startswith("Command is not allowed")
    controller.remote = True
    assert DashboardServer(controller, CB3).answer("play", 0.0) == "Failed to execute: play"
    dashboard = DashboardServer(controller, E_SERIES)
    controller.upload("def rtde_control():\nend\n", 0.0)
    assert controller.program is None
    for order, answer, mode in (
        ("power on", "Powering on", "IDLE"),
        ("brake release", "Brake releasing", "RUNNING"),
        ("power on", "Powering on", "RUNNING"),
        ("power off", "Powering off", "POWER_OFF"),
        ("brake release", "Brake releasing", "RUNNING"),
    ):
        assert dashboard.answer(order, 1.0) == answer
        assert dashboard.answer("robotmode", 1.0) == f"Robotmode: {mode}"
    assert dashboard.answer("play", 2.0) == "Starting program"


def test_a_protective_stop_pauses_a_program_and_play_waits_for_its_end() -> None:
    log = Log()
    controller = EmulatedController(StraightTool(), log)
    dashboard = DashboardServer(controller, E_SERIES)
    dashboard.answer("play", 0.0)
    controller.set_safety("PROTECTIVE_STOP", 1.0)
    assert dashboard.answer("safetystatus", 1.0) == "Safetystatus: PROTECTIVE_STOP"
    assert dashboard.answer("programState", 1.0) == "PAUSED shuttle.urp"
    assert dashboard.answer("play", 1.0) == "Failed to execute: play"
    assert dashboard.answer("unlock protective stop", 5.9).startswith("Cannot unlock protective stop until 5s")
    assert dashboard.answer("unlock protective stop", 6.0) == "Protective stop releasing"
    assert controller.runtime == PAUSED
    assert dashboard.answer("play", 6.0) == "Starting program"
    assert log == ["started", "safety", "paused", "safety", "resumed"]


@pytest.mark.parametrize(
    ("stop", "runtime_afterwards"),
    [
        ("PROTECTIVE_STOP", PAUSED),
        ("SAFEGUARD_STOP", PLAYING),
        ("SYSTEM_THREE_POSITION_ENABLING_STOP", PAUSED),
        ("ROBOT_EMERGENCY_STOP", STOPPED),
    ],
)
def test_a_stopped_script_continues_its_move(stop: str, runtime_afterwards: int) -> None:
    controller, goal_m = EmulatedController(StraightTool(), Log()), START_POSE[2] + 0.1
    controller.upload("def rtde_control():\nend\n", 0.0)
    move = {f"input_double_register_{index}": value for index, value in enumerate((*START_POSE, 0.1, 1.0))}
    move |= {"input_double_register_2": goal_m, "input_int_register_0": 3, "input_int_register_1": 1}
    controller.take(move, 0.0)
    controller.cycle(0.0)
    controller.set_safety(stop, 0.5)
    assert controller.outputs(0.5)["safety_status_bits"][0] & 1 << 10, "stopped due to safety"
    assert not controller.tool.under_way(1.0)
    assert controller.tool.pose(1.0)[2] < goal_m - 0.03
    controller.set_safety("NORMAL", 6.0)
    assert controller.runtime == runtime_afterwards
    if runtime_afterwards != STOPPED:
        controller.play(6.0)
        assert controller.tool.pose(9.0)[2] == pytest.approx(goal_m)


def test_a_dashboard_may_refuse_to_end_a_program_during_a_stop() -> None:
    controller = EmulatedController(StraightTool(), Log())
    dashboard = DashboardServer(controller, E_SERIES)
    controller.refuses_stop = True
    controller.play(0.0)
    controller.set_safety("PROTECTIVE_STOP", 1.0)
    assert dashboard.answer("stop", 1.0) == "Failed to execute: stop"
    controller.set_safety("NORMAL", 7.0)
    assert dashboard.answer("stop", 7.0) == "Stopped"


def test_an_uploaded_script_replaces_the_running_program() -> None:
    log = Log()
    controller = EmulatedController(StraightTool(), log)
    controller.play(0.0)
    controller.upload("def rtde_control():\nend\n", 1.0)
    assert log == ["started", "script", "ended", "started"]


def test_a_tool_moves_straight_and_stops_within_its_deceleration() -> None:
    tool = StraightTool()
    assert tool.pose(10.0) == START_POSE
    goal = (START_POSE[0] + 0.03, START_POSE[1], START_POSE[2] + 0.04, *START_POSE[3:])
    tool.move(10.0, goal, 0.1, 1.0)
    assert math.hypot(*tool.velocity(10.3)[:3]) == pytest.approx(0.1)
    tool.stop(10.3, 2.0)
    assert tool.under_way(10.34)
    assert not tool.under_way(10.36)
    tool.move(11.0, goal, 0.1, 1.0)
    assert tool.pose(12.0) == pytest.approx(goal)
    assert not tool.under_way(12.0)


def test_the_worlds_arm_follows_the_height_of_a_goal() -> None:
    world = World()
    tool = WorldTool(world)
    tool.move(1.0, (*START_POSE[:2], START_POSE[2] + 0.1, *START_POSE[3:]), 0.1, 1.0)
    assert tool.velocity(1.5)[2] == pytest.approx(0.1)
    assert world.arm_state(1.5).moving
    assert tool.pose(3.0)[2] == pytest.approx(START_POSE[2] + 0.1)
    tool.move(3.0, START_POSE, 0.1, 1.0)
    tool.stop(3.2, 2.5)
    assert not tool.under_way(3.5)
    assert START_POSE[2] + 0.05 < tool.pose(3.5)[2] < START_POSE[2] + 0.1


async def test_commands_and_an_address_in_use() -> None:
    first, second = (UrEmulator(UrEmulator.Settings(host=HOST, series="e")) for _ in range(2))
    await first.start()
    with pytest.raises(InputError, match=f"cannot listen on {HOST}:30004"):
        await second.start()
    await second.stop()
    assert first.control("panel play") == "power off, local control, normal, program stopped"
    assert first.control("panel on").startswith("power on")
    assert first.control("panel remote").startswith("power on, remote control")
    assert first.control("panel play").endswith("program playing")
    first.control("fault protective_stop")
    assert first.control("panel unlock").endswith("protective stop, program paused"), "5 s are not over"
    first.control("clear")
    assert first.control("fault emergency_stop") == "emergency_stop: until cleared"
    assert (first.state()["safety"], first.state()["runtime"]) == ("robot emergency stop", "stopped")
    first.control("clear")
    assert (first.state()["safety"], first.state()["power"]) == ("normal", "on")
    with pytest.raises(CommandRefused, match="the faults are: freeze, silence"):
        first.control("fault nonsense")
    assert "panel play|pause|stop|unlock|on|off|remote|local" in first.control("help")
    reader, writer = await asyncio.open_connection(HOST, 29999)
    assert (await reader.readline()).startswith(b"Connected")
    first.control("fault kill")
    assert await reader.read() == b"", "a controller that is gone has hung up"
    writer.close()
    await first.stop()
