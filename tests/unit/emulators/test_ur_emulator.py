"""The emulated controller from the inside: its dashboard's answers, its programs, its tools, its control words."""

from __future__ import annotations

import asyncio
import math
import os

import pytest

from slipguard.errors import CommandRefused, InputError
from slipguard.sim.world import World
from slipguard_emulators.ur5.controller import EmulatedController
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


def test_a_protective_stop_pauses_a_program_and_play_waits_for_its_end() -> None:
    log = Log()
    controller = EmulatedController(StraightTool(), log)
    dashboard = DashboardServer(controller, E_SERIES)
    dashboard.answer("play", 0.0)
    controller.set_safety("PROTECTIVE_STOP", 1.0)
    assert dashboard.answer("safetystatus", 1.0) == "Safetystatus: PROTECTIVE_STOP"
    assert dashboard.answer("play", 1.0) == "Failed to execute: play"
    assert dashboard.answer("unlock protective stop", 2.0) == "Protective stop releasing"
    assert dashboard.answer("play", 2.0) == "Starting program"
    assert log == ["started", "safety", "paused", "safety", "resumed"]


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
    first, second = (UrEmulator(UrEmulator.Settings(host=HOST)) for _ in range(2))
    await first.start()
    with pytest.raises(InputError, match=f"{HOST}:30004 cannot be listened on"):
        await second.start()
    await second.stop()
    assert first.control("panel play") == "playing"
    assert first.control("fault emergency_stop") == "emergency_stop: until cleared"
    assert (first.state()["safety"], first.state()["runtime"]) == ("robot emergency stop", "stopped")
    first.control("clear")
    assert first.state()["safety"] == "normal"
    with pytest.raises(CommandRefused, match="the faults are: freeze, silence"):
        first.control("fault nonsense")
    assert "panel play|pause|stop" in first.control("help")
    reader, writer = await asyncio.open_connection(HOST, 29999)
    assert (await reader.readline()).startswith(b"Connected")
    first.control("fault kill")
    assert await reader.read() == b"", "a controller that is gone has hung up"
    writer.close()
    await first.stop()
