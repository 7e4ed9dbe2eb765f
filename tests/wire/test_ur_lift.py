"""Lift mode when the loop, the worker, the link or the controller goes astray: the arm stops, and nothing hangs."""

from __future__ import annotations

import asyncio
import os
import signal
import threading
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from typing import Literal

import pytest
from ur_scene import lifting, lost, opened, own_address, put_away, refusal, rests, script_commands, under_way, until

from slipguard.errors import CommandRefused, DeviceLost
from slipguard.thread_priority import set_batch_priority
from slipguard_drivers.ur5.lift_mode import LiftModeArm
from slipguard_drivers.ur5.rtde import RtdeConnection
from slipguard_emulators.ur5.emulator import UrEmulator

HOST = own_address(31)


@pytest.fixture(autouse=True)
async def _put_away() -> AsyncIterator[None]:
    yield
    await put_away()


@pytest.fixture
async def controller() -> AsyncIterator[UrEmulator]:
    controller = UrEmulator(UrEmulator.Settings(host=HOST, series="cb3", ready=True))
    await controller.start()
    yield controller
    await controller.stop()


@pytest.fixture
async def arm(controller: UrEmulator) -> AsyncIterator[LiftModeArm]:
    arm = lifting(HOST)
    await arm.open()
    yield arm
    await put_away()


def dashboard_orders(controller: UrEmulator) -> list[object]:
    """What the driver has ordered there, without its questions and ur-rtde's."""
    return [event["asked"] for event in controller.events("dashboard") if event["asked"] in ("stop", "pause", "play")]


def saw_no_program(arm: LiftModeArm) -> bool:
    """Whether the driver has received that no program runs. No person starts one within the 8 ms of a packet."""
    return arm._script.has_ended


async def test_the_watchdog_is_armed_before_anything_moves(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    assert script_commands(controller)[:3] == ["watchdog at 2 Hz", "pose_trans", "movel in a thread"]


async def test_the_worker_does_not_inherit_a_special_priority(controller: UrEmulator) -> None:
    """ur-rtde polls without a pause: with the loop's real-time priority it would stand above the fingers' threads."""
    arm = lifting(HOST)
    with ThreadPoolExecutor(1, initializer=set_batch_priority, initargs=(0,)) as back:
        back.submit(arm._worker.start_spare).result()
    await opened(arm)
    threads = [int(name) for name in os.listdir(f"/proc/{arm._worker.pid}/task")]
    assert len(threads) > 1
    assert {os.sched_getscheduler(thread) for thread in threads} == {os.SCHED_OTHER}


async def test_a_stop_is_a_linear_one(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    await arm.stop()
    assert script_commands(controller)[-1] == "stopl", "a synchronous one would be carried out as stopj, in rad/s2"
    assert await rests(controller)


async def test_a_new_motion_waits_until_the_old_one_has_ended(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    for height_mm, speed_mm_s in ((50.0, 20.0), (-50.0, 100.0), (50.0, 250.0)):
        await arm.lift(height_mm, speed_mm_s)
        assert script_commands(controller)[-2:] == ["stopl", "movel in a thread"]
        await asyncio.sleep(0.05)
    assert not controller.events("ended"), "two threads that move the arm would end the script"


async def test_a_stop_during_the_wait_prevents_the_new_motion(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    stopping: list[asyncio.Future[None]] = []
    controller._report = lambda event: stopping or stopping.append(asyncio.ensure_future(arm.stop()))
    with pytest.raises(CommandRefused, match="stopped during the command"):
        await arm.lift(50.0, 100.0)
    await stopping[0]
    assert script_commands(controller).count("movel in a thread") == 1


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGSTOP], ids=["dies", "hangs"])
async def test_a_dead_worker_stops_the_arm(controller: UrEmulator, arm: LiftModeArm, how: signal.Signals) -> None:
    await under_way(arm, controller)
    assert arm._worker.pid is not None
    os.kill(arm._worker.pid, how)
    assert await rests(controller)
    await lost(arm)
    await arm.open()
    assert not (await arm.state()).moving
    assert await arm.lift(5.0, 50.0) == 50.0


async def test_a_loop_that_hangs_stops_the_arm(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    before = arm._worker.pid
    threading.Event().wait(0.6)  # the emulator hangs with the loop: its watchdog acts when it goes on
    assert await rests(controller)
    assert controller.events("ended")[-1]["why"] == "its watchdog received nothing"
    await lost(arm)
    await arm.open()
    assert arm._worker.pid != before


@pytest.mark.parametrize("how", ["drop 1", "half 1", "garbage 1", "kill"])
async def test_a_link_that_breaks_stops_the_arm(controller: UrEmulator, arm: LiftModeArm, how: str) -> None:
    await under_way(arm, controller)
    controller.control(f"fault {how}")
    assert await rests(controller)
    await lost(arm)
    assert arm._worker.pid is None, "ur-rtde would connect again by itself, and start its script"
    assert len(controller.events("script")) == 1, "only open starts the script again"
    controller.control("clear")
    await asyncio.sleep(0.05)
    await arm.open()
    await arm.state()


async def test_a_stop_of_a_lost_arm_goes_to_the_dashboard(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller._servers[0].unplug()
    controller.control("fault drop 1")
    assert await rests(controller)
    await lost(arm)
    await asyncio.sleep(0.1)
    orders = len(dashboard_orders(controller))
    with pytest.raises(DeviceLost, match="a stop was sent to the dashboard"):
        await arm.stop()
    assert len(dashboard_orders(controller)) == orders + 1


async def test_a_stop_of_an_unopened_arm_affects_no_program(controller: UrEmulator) -> None:
    controller.control("panel play")
    with pytest.raises(DeviceLost, match="not open"):
        await lifting(HOST).stop()
    assert dashboard_orders(controller) == []


@pytest.mark.realtime
async def test_a_program_started_after_our_script_is_not_ours(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    assert arm._worker.pid is not None
    os.kill(arm._worker.pid, signal.SIGKILL)
    await lost(arm)
    assert await until(lambda: controller.state()["runtime"] == "stopped")
    assert await until(lambda: saw_no_program(arm))
    controller.control("panel play")
    assert "a program is running or paused" in await refusal(arm, "a program is running or paused")
    with pytest.raises(DeviceLost):
        await arm.stop()
    assert controller.state()["runtime"] == "playing"


async def test_without_states_the_arm_is_commanded_to_stop(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    controller.control("fault freeze")
    assert await rests(controller)
    assert "stopl" in script_commands(controller), "blind is not deaf: it is reported before it is given up"
    await lost(arm)
    assert arm._worker.pid is None


async def test_ur_rtdes_report_is_compared_with_the_monitored_motion(
    controller: UrEmulator, arm: LiftModeArm, monkeypatch: pytest.MonkeyPatch
) -> None:
    call = arm._worker.call

    async def blind(request: str, *arguments: object, timeout_s: float) -> object:
        answer = await call(request, *arguments, timeout_s=timeout_s)
        return answer | {"moving": False} if request == "beat" else answer

    monkeypatch.setattr(arm._worker, "call", blind)
    await under_way(arm, controller)
    assert "ur-rtde reports the opposite" in await lost(arm)
    assert await rests(controller)


async def test_late_packets_are_tolerated(controller: UrEmulator, arm: LiftModeArm) -> None:
    controller.control("fault late 0.05")
    await under_way(arm, controller)
    assert (await arm.state()).moving
    await arm.stop()
    assert await rests(controller)


@pytest.mark.realtime
async def test_after_a_stop_at_the_panel_the_arm_belongs_to_the_panel(controller: UrEmulator, arm: LiftModeArm) -> None:
    await under_way(arm, controller)
    orders = dashboard_orders(controller)
    controller.control("panel stop")
    assert await until(lambda: saw_no_program(arm))
    controller.control("panel play")
    assert "script" in await lost(arm)
    words = "a program is running or paused (PLAYING shuttle.urp)"
    assert words in await refusal(arm, words)
    await arm.close()
    assert dashboard_orders(controller) == orders, "what runs now is another program's"
    assert controller.state()["runtime"] == "playing"


@pytest.mark.parametrize("press", ["panel play", "panel pause"])
async def test_another_program_is_not_ended(controller: UrEmulator, press: str) -> None:
    controller.control("panel play")
    controller.control(press)
    arm = lifting(HOST)
    with pytest.raises(DeviceLost, match='mode = "guard"'):
        await arm.open()
    await arm.close()
    assert not controller.events("ended")
    assert not controller.events("script")


async def test_the_script_of_a_killed_daemon_ends_by_its_watchdog(controller: UrEmulator, arm: LiftModeArm) -> None:
    newcomer = lifting(HOST)
    assert "a program is running or paused" in await refusal(newcomer, "a program is running or paused")
    await under_way(arm, controller)
    assert arm._worker.pid is not None
    os.kill(arm._worker.pid, signal.SIGKILL)
    assert await until(lambda: controller.state()["runtime"] == "stopped")
    await opened(newcomer)
    await newcomer.close()


@pytest.mark.parametrize(
    ("series", "fault", "words"),
    [
        ("e", "local", "switch it to remote control"),
        ("cb3", "fieldbus", "EtherNet/IP"),
        ("cb3", "silence", "does not answer"),
    ],
)
async def test_obstacles_are_reported_before_ur_rtde_connects(
    series: Literal["e", "cb3"], fault: str, words: str
) -> None:
    controller = UrEmulator(UrEmulator.Settings(host=HOST, series=series, ready=True))
    await controller.start()
    try:
        controller.control(f"fault {fault}")
        arm = lifting(HOST)
        said = await refusal(arm, words)
        assert words in said
        assert "\n" not in said
        assert arm._worker.pid is None
        assert not controller.events("script")
    finally:
        await controller.stop()


async def test_registers_in_use_can_be_avoided(controller: UrEmulator) -> None:
    other = await RtdeConnection.connect("other", HOST)
    await other.claim_inputs(["input_int_register_0"])
    arm = lifting(HOST)
    assert 'registers = "upper"' in await refusal(arm, 'registers = "upper"')
    arm = lifting(HOST, registers="upper")
    await opened(arm)
    await under_way(arm, controller)
    await arm.stop()
    assert await rests(controller)
    await arm.close()
    other.close()


async def test_without_a_controller_open_names_the_port() -> None:
    arm = lifting(HOST)
    with pytest.raises(DeviceLost, match=f"no answer from {HOST}:30004"):
        await arm.open()
    assert arm._worker.pid is None


@pytest.mark.realtime
async def test_a_controller_that_does_not_answer_does_not_block_the_loop(controller: UrEmulator) -> None:
    controller.control("fault silence")
    arm = lifting(HOST)
    loop = asyncio.get_running_loop()
    opening = asyncio.ensure_future(arm.open())
    longest_s, last_s = 0.0, loop.time()
    while not opening.done():
        await asyncio.sleep(0.005)
        longest_s, last_s = max(longest_s, loop.time() - last_s), loop.time()
    assert longest_s < 0.3
    with pytest.raises(DeviceLost, match="does not answer"):
        await opening
    assert arm._worker.pid is None


async def test_a_cancelled_open_leaves_nothing_behind(controller: UrEmulator) -> None:
    controller.control("fault silence")
    arm = lifting(HOST)
    with pytest.raises(TimeoutError):
        await asyncio.wait_for(arm.open(), 0.05)
    controller.control("clear")
    opening = asyncio.ensure_future(arm.open())
    assert await until(lambda: arm._worker.pid is not None)
    opening.cancel()
    with pytest.raises(asyncio.CancelledError):
        await opening
    assert arm._worker.pid is None
    await asyncio.sleep(0.05)
    await arm.open()
    await arm.close()
