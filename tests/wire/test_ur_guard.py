"""Guard mode next to another program and a ROS-like RTDE client: neither is disturbed but by an intended pause."""

from __future__ import annotations

import asyncio
import contextlib
import sys
from collections.abc import AsyncIterator
from typing import Literal

import pytest
from ros_client import RosLikeClient
from ur_scene import lifting, lost, own_address, put_away, rests, speed_of, until

from slipguard.daemon.loop.actuator import Actuator
from slipguard.devices import ArmState
from slipguard.errors import CommandRefused, DeviceLost
from slipguard_drivers.ur5.dashboard import DashboardClient
from slipguard_drivers.ur5.diagnostics import check_dashboard
from slipguard_drivers.ur5.guard_mode import GuardModeArm
from slipguard_drivers.ur5.settings import Ur5Settings
from slipguard_emulators.ur5.emulator import UrEmulator

HOST = own_address(32)


both_series = pytest.mark.parametrize("controller", ["e", "cb3"], indirect=True)


@pytest.fixture
async def controller(request: pytest.FixtureRequest) -> AsyncIterator[UrEmulator]:
    series: Literal["e", "cb3"] = getattr(request, "param", "cb3")
    controller = UrEmulator(UrEmulator.Settings(host=HOST, series=series, ready=True))
    await controller.start()
    controller.control("panel play")
    yield controller
    await controller.stop()


@pytest.fixture
async def ros(controller: UrEmulator) -> AsyncIterator[RosLikeClient]:
    client = RosLikeClient(HOST)
    await client.start()
    yield client
    assert client.ended is None, "the other client has lost its connection"
    packets = client.packets
    assert await until(lambda: client.packets > packets + 5), "the other client is reported nothing any more"
    await client.stop()


def pausing(**settings: object) -> GuardModeArm:
    return GuardModeArm("arm", Ur5Settings.model_validate({"host": HOST, **settings}))


def no_rtde(controller: UrEmulator) -> None:
    """RTDE is gone for good; the dashboard is still there for who connects again."""
    for server in controller._servers:
        server.cut()
    controller._servers[0].unplug()


def disturbances(controller: UrEmulator) -> list[str]:
    """What has happened to the program since it was started, and every script that was sent."""
    return [str(event["event"]) for event in controller.log if event["event"] in ("paused", "ended", "script")]


@both_series
async def test_connecting_and_disconnecting_disturb_no_program(controller: UrEmulator, ros: RosLikeClient) -> None:
    for _ in range(5):
        arm = pausing()
        await arm.open()
        for _ in range(20):
            assert not (await arm.state()).protective_stop
            with pytest.raises(CommandRefused):
                await arm.lift(10.0, 50.0)
            await asyncio.sleep(0.005)
        await arm.close()
    assert disturbances(controller) == []
    assert speed_of(controller) > 0.0 or await until(lambda: speed_of(controller) > 0.0)


@both_series
async def test_only_a_stop_pauses_the_program_and_it_can_continue(controller: UrEmulator, ros: RosLikeClient) -> None:
    arm = pausing()
    await arm.open()
    assert await until(lambda: speed_of(controller) > 0.05)
    for _ in range(4):
        await arm.stop()
    assert await rests(controller)
    assert disturbances(controller) == ["paused"]
    await asyncio.sleep(0.05)
    assert not (await arm.state()).moving
    controller.control("panel play")
    assert await until(lambda: speed_of(controller) > 0.05)
    await asyncio.sleep(0.1)
    assert disturbances(controller) == ["paused"]
    await arm.stop()
    assert await rests(controller)
    assert disturbances(controller) == ["paused", "paused"]
    await arm.close()


async def test_a_stop_where_nothing_runs_is_no_error(controller: UrEmulator) -> None:
    arm = pausing()
    await arm.open()
    controller.control("panel stop")
    assert await rests(controller)
    await asyncio.sleep(0.05)
    await arm.stop()
    controller.control("fault freeze")  # not even where it is not seen that nothing runs
    await asyncio.sleep(0.1)
    await arm.stop()
    assert disturbances(controller) == ["ended"]
    await arm.close()


@pytest.mark.parametrize("fault", ["drop 1", "freeze", "kill", "garbage 1", "half 1", "silence", "late"])
async def test_no_fault_of_the_link_reaches_the_program(controller: UrEmulator, fault: str) -> None:
    arm = pausing()
    actuator: Actuator[ArmState] = Actuator("arm", arm, 0.02, 0.05, lambda: None, lambda event: None)
    running = asyncio.create_task(actuator.run(), name="actuator")
    assert await until(lambda: actuator.health.ready)
    controller.control(f"fault {fault}")
    await asyncio.sleep(0.4)
    controller.control("clear")
    if fault == "kill":  # with the controller its program is gone
        controller.log.clear()
        controller.control("panel play")
    assert await until(lambda: actuator.health.ready, 4.0), actuator.health.reason
    assert disturbances(controller) == []
    actuator.command(arm.stop)
    assert await rests(controller)
    assert disturbances(controller) == ["paused"]
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running


async def test_ur_rtde_is_not_imported(controller: UrEmulator) -> None:
    arm = pausing()
    await arm.open()
    await arm.stop()
    await arm.close()
    assert "rtde_control" not in sys.modules


async def test_an_output_is_pulsed_and_freed(controller: UrEmulator) -> None:
    arm = pausing(stop_by="digital_output", digital_output=3, pulse_ms=100.0)
    await arm.open()
    ros = RosLikeClient(HOST)
    await ros.start()  # nothing is kept from a program that comes later
    await ros.stop()
    await asyncio.sleep(0.05)
    await arm.stop()
    assert controller.controller.output_bits == 0b1000
    await arm.stop()
    assert await until(lambda: controller.controller.output_bits == 0)
    assert [event["bits"] for event in controller.events("outputs")] == [0b1000, 0]
    assert disturbances(controller) == [], "what the output means is the program's affair"
    await arm.close()


async def test_an_output_in_use_is_refused(controller: UrEmulator, ros: RosLikeClient) -> None:
    arm = pausing(stop_by="digital_output", digital_output=3)
    with pytest.raises(
        DeviceLost, match=r"another program holds standard_digital_output.* ROS driver.*dashboard_pause"
    ):
        await arm.open()
    assert disturbances(controller) == []


async def test_an_output_in_use_is_replaced_by_a_pause_and_reported(controller: UrEmulator) -> None:
    arm = pausing(stop_by="digital_output", digital_output=3)
    await arm.open()
    ros = RosLikeClient(HOST)
    await ros.start()
    with pytest.raises(CommandRefused, match="paused by the dashboard instead"):
        await arm.stop()
    assert await rests(controller)
    assert disturbances(controller) == ["paused"]
    await ros.stop()
    await arm.close()


async def test_a_stop_needs_no_rtde(controller: UrEmulator) -> None:
    arm, said = pausing(), list[str]()
    actuator: Actuator[ArmState] = Actuator("arm", arm, 0.025, 0.5, lambda: None, said.append)
    running = asyncio.create_task(actuator.run(), name="actuator")
    assert await until(lambda: actuator.health.ready)
    assert await until(lambda: speed_of(controller) > 0.05)
    no_rtde(controller)
    assert await until(lambda: not actuator.health.ready)
    actuator.command(arm.stop)
    assert await rests(controller, 1.0)
    assert disturbances(controller) == ["paused"]
    assert await until(lambda: said)
    assert "the stop was sent all the same" in said[0]
    running.cancel()
    with contextlib.suppress(asyncio.CancelledError):
        await running


async def test_a_stop_needs_no_open(controller: UrEmulator) -> None:
    with pytest.raises(DeviceLost, match=r"not open.* the stop was sent all the same"):
        await pausing().stop()
    assert disturbances(controller) == ["paused"]


async def test_one_missing_dashboard_answer_is_tolerated(
    controller: UrEmulator, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm = pausing()
    await arm.open()
    asked = 0

    async def silent() -> bool:
        nonlocal asked
        asked += 1
        if asked == 2:
            return True
        raise DeviceLost("arm: (dashboard) did not answer")

    monkeypatch.setattr(arm._dashboard, "in_remote_control", silent)
    assert "did not answer" in await lost(arm)
    assert asked == 4, "once, and after an answer twice"
    await arm.close()


async def test_an_output_that_is_high_already_is_replaced_by_a_pause(controller: UrEmulator) -> None:
    arm = pausing(stop_by="digital_output", digital_output=3)
    await arm.open()
    controller.controller.output_bits = 0b1000
    with pytest.raises(CommandRefused, match=r"output 3 is high already.*paused by the dashboard instead"):
        await arm.stop()
    assert await rests(controller)
    assert disturbances(controller) == ["paused"]
    await arm.close()


async def test_a_pulse_ends_after_its_connection_was_lost(controller: UrEmulator) -> None:
    arm = pausing(stop_by="digital_output", digital_output=3, pulse_ms=100.0)
    await arm.open()
    await arm.stop()
    assert controller.controller.output_bits == 0b1000
    controller.control("fault drop 1")
    assert await until(lambda: controller.controller.output_bits == 0)
    await arm.close()


async def test_a_pulse_that_cannot_be_ended_is_reported(controller: UrEmulator) -> None:
    arm = pausing(stop_by="digital_output", digital_output=3, pulse_ms=100.0)
    await arm.open()
    await arm.stop()
    no_rtde(controller)
    await lost(arm)
    await arm.close()
    controller._servers[0].plug()
    await arm.open()
    assert "output 3 may still be high" in await lost(arm)
    await arm.open()
    await asyncio.sleep(0.6)
    await arm.state()
    await arm.close()


async def test_local_control_is_reported() -> None:
    controller = UrEmulator(UrEmulator.Settings(host=HOST, ready=True))
    await controller.start()
    controller.control("panel play")
    controller.control("fault local")
    arm = pausing()
    with pytest.raises(DeviceLost, match="local control"):
        await arm.open()
    controller.control("clear")
    await arm.open()
    controller.control("fault local")
    assert "local control" in await lost(arm)
    assert disturbances(controller) == []
    await arm.close()
    await controller.stop()


async def test_lift_mode_next_to_a_running_program_would_not_even_start(controller: UrEmulator) -> None:
    with pytest.raises(DeviceLost, match="a program is running or paused"):
        await lifting(HOST).open()
    await put_away()
    assert disturbances(controller) == []


@pytest.mark.parametrize(
    ("press", "owned", "level"), [("play", False, "problem"), ("pause", False, "problem"), ("play", True, "ok")]
)
async def test_the_doctor_reports_it_too(controller: UrEmulator, press: str, owned: bool, level: str) -> None:
    controller.control(f"panel {press}")
    dashboard = DashboardClient("arm", HOST)
    results = [
        result async for result in check_dashboard("arm", dashboard, Ur5Settings(host=HOST), "lift", owned=owned)
    ]
    dashboard.close()
    assert [result.status.name.lower() for result in results if result.check == "program"] == [level]
    assert disturbances(controller) == (["paused"] if press == "pause" else [])
