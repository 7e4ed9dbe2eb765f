"""Missing devices at the start, messages to systemd, a shutdown at any moment, and a restart with an object held."""

from __future__ import annotations

import asyncio
import contextlib
import os
import signal
import socket
import threading
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import structlog
from loop_cell import Cell, on_cell, play, running
from sampled import sampled
from structlog.testing import capture_logs

from slipguard.config import parse_config
from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import Observation, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.state import Phase
from slipguard.daemon import lifecycle
from slipguard.daemon import run as root
from slipguard.daemon.api.requests import GraspRequest
from slipguard.daemon.loop.actuator import Actuator
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.devices import Frame
from slipguard.errors import CommandRefused, DeviceLost, DeviceTimeout
from slipguard.sim.world import World, WorldSettings

BRISK: dict[str, object] = {"lift_height_mm": 50.0, "lift_speed_mm_s": 80.0, "tuning": {"lower_speed_mm_s": 150.0}}
DEVICES = ("left", "right", "gripper", "arm")


@pytest.mark.parametrize("device", DEVICES)
@on_cell("wrench", 1)
async def test_a_device_missing_at_the_start_is_waited_for_by_name(cell: Cell, device: str) -> None:
    cell.world.faults.fail(device, "disconnect")
    await asyncio.sleep(7.0)
    (line,) = cell.service.waiting_for
    assert line.startswith(f"{device}: no ")
    with pytest.raises(CommandRefused, match=f"cannot grasp: not ready: {device}: (?!{device}: )"):
        await cell.submit(GraspRequest())
    cell.world.faults.repair(device)
    await cell.until(lambda: not cell.service.waiting_for, 5.1)  # ten times the first pause is the longest
    await cell.grasp()
    assert cell.phase is Phase.HOLDING


@pytest.mark.parametrize("seed", sampled(range(20), every=6))
def test_a_shutdown_at_any_moment_leaves_the_grip_as_it_is(seed: int) -> None:
    """`running` checks that no task is left and that the workers are closed."""
    moment_s = float(np.random.default_rng(seed).uniform(0.0, 7.0))

    async def main() -> None:
        cell = Cell("wrench", seed, guard=BRISK)
        async with running(cell):
            errand = asyncio.create_task(carry(cell))
            await asyncio.sleep(moment_s)
            before, count = cell.truth, len(cell.gripper.commands)
            errand.cancel()
            await asyncio.gather(errand, return_exceptions=True)
        await asyncio.sleep(2.0)
        after = cell.truth
        assert len(cell.gripper.commands) == count
        assert not any(what in ("release", "move") for _, what, _ in cell.gripper.commands)
        assert after.force_n >= before.force_n
        assert after.in_contact or not before.in_contact
        stopped_mm = cell.truth.height_mm
        await asyncio.sleep(0.5)
        assert cell.truth.height_mm == stopped_mm

    run_virtual(main())


async def carry(cell: Cell) -> None:
    await cell.grasp()
    await cell.lift()
    await cell.lower()


@pytest.mark.parametrize("first", ["left", "gripper", "arm"])
def test_a_restart_adopts_the_held_object_and_guards_it(first: str) -> None:
    """The new service finds the devices in another order each time; this neither loosens the grip nor needs help."""

    async def main() -> None:
        world = World(seed=1)
        old = Cell("wrench", 1, guard=BRISK, world=world)
        old.fresh = True
        async with running(old):
            await old.grasp()
            held_n = old.truth.applied_n
        new = Cell("wrench", 1, guard=BRISK, world=world)
        for device in DEVICES:
            if device != first:
                world.faults.fail(device, "disconnect")
        async with running(new):
            await asyncio.sleep(1.0)
            for device in DEVICES:
                world.faults.repair(device)
                await asyncio.sleep(0.3)
            await new.until(new.steady)
            assert new.service.state.held.referenced
            assert new.truth.applied_n == held_n
            assert new.gripper.commands == []
            assert Phase.FAULT not in new.phases, new.messages
            await new.lift()
            await asyncio.sleep(0.5)
            assert new.phase is Phase.HOLDING
            assert new.truth.dropped is None
            assert abs(new.truth.rotation_deg) < 20.0
            assert new.truth.applied_n > held_n

    run_virtual(main())


def test_a_missing_arm_does_not_leave_a_found_object_unguarded() -> None:
    async def main() -> None:
        world = World(seed=1)
        old = Cell("wrench", 1, guard=BRISK, world=world)
        old.fresh = True
        async with running(old):
            await old.grasp()
        new = Cell("wrench", 1, guard=BRISK, world=world)
        world.faults.fail("arm", "disconnect")
        async with running(new):
            await new.until(lambda: new.phase is Phase.FAULT)
            assert any("arm silent" in line for line in new.service.event_log.lines)
            assert new.service.state.guarding
            assert new.truth.in_contact
            events = new.service.event_log.events
            world.faults.fail("gripper", "disconnect")
            await new.until(lambda: any("gripper silent" in event.text for event in events))
            assert {event.level for event in events if "gripper silent" in event.text} == {"warning"}, (
                "in addition to a fault"
            )

    run_virtual(main())


WATCHDOG_S = 3.0


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Listens as systemd does, with WatchdogSec=3."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", str(int(WATCHDOG_S * 1e6)))
        yield listening


def messages(listening: socket.socket) -> list[str]:
    received = []
    while True:
        try:
            received.append(listening.recv(500).decode())
        except BlockingIOError:
            return received


@on_cell()
async def test_a_healthy_loop_feeds_the_watchdog_twice_in_its_time(cell: Cell, systemd: socket.socket) -> None:
    received: list[str] = []
    await cell.ready()
    received.extend(messages(systemd))
    for _ in range(10):
        start_s = cell.now_s
        await cell.until(lambda start_s=start_s: cell.now_s >= start_s + WATCHDOG_S)  # type: ignore[misc]
        fed = messages(systemd)
        assert fed.count("WATCHDOG=1") == 2, fed
    await cell.grasp()
    assert received[0] == "READY=1"
    assert "STATUS=holding" in messages(systemd)


def test_a_controller_error_ends_the_service_and_feeds_nothing_more(systemd: socket.socket) -> None:
    """Sensors, gripper and arm go on answering until then: they are no sign of health."""
    rotations = 0

    def broken(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, StepOutput]:
        nonlocal rotations
        rotations += 1
        if rotations > 50:
            raise ZeroDivisionError("a mistake in the controller")
        return control_step(state, observation, params)

    async def scene(cell: Cell) -> None:
        await cell.until(lambda: False, 20.0)

    with pytest.raises((ExceptionGroup, AssertionError)):
        play(Cell(controller=broken), scene)
    received = messages(systemd)
    assert received.count("WATCHDOG=1") == 1  # in the first cycle
    assert received[-1] == "STOPPING=1"


ROTATIONS = range(16)


async def swallowing() -> None:
    """As `asyncio.wait_for` until Python 3.12, where the result arrives in the same cycle of the event loop."""
    with contextlib.suppress(asyncio.CancelledError):
        await asyncio.sleep(0)


class Careless:
    """A device and a sensor that swallow a cancellation wherever they wait. there: whether it opens."""

    serial = "D1"
    remarks = ()

    def __init__(self, there: bool) -> None:
        self.there = there

    async def open(self) -> None:
        await swallowing()
        if not self.there:
            raise DeviceLost("motor: unplugged; plug it in")

    async def state(self) -> int:
        await swallowing()
        return 1

    async def next_frame(self) -> Frame:
        await swallowing()
        raise DeviceTimeout("motor: no frame")

    async def stop(self) -> None:
        await swallowing()

    async def close(self) -> None:
        await swallowing()


def ended_when_cancelled_at(rotation: int, make: Callable[[], Coroutine[Any, Any, None]]) -> bool:
    async def main() -> bool:
        task = asyncio.create_task(make())
        for _ in range(rotation):
            await asyncio.sleep(0)
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=5.0)
        return bool(done)

    return run_virtual(main())


def driven(device: Careless) -> Coroutine[Any, Any, None]:
    actuator: Actuator[int] = Actuator("motor", device, 0.02, 0.5, lambda: None, lambda line: None)
    actuator.command(device.stop)
    return actuator.run()


def captured(sensor: Careless) -> Coroutine[Any, Any, None]:
    finger = Cell().service.fingers["left"]
    finger.capture.sensor = sensor  # type: ignore[assignment]
    return finger.run()


@pytest.mark.parametrize("there", [False, True])
@pytest.mark.parametrize("run", [driven, captured])
@pytest.mark.parametrize("rotation", ROTATIONS)
def test_a_driver_that_swallows_a_cancellation_is_closed(
    rotation: int, run: Callable[[Careless], Coroutine[Any, Any, None]], there: bool
) -> None:
    assert ended_when_cancelled_at(rotation, lambda: run(Careless(there)))


async def one_that_stays() -> None:
    """Go on after the request to end."""
    try:
        await asyncio.Event().wait()
    except asyncio.CancelledError:
        await asyncio.Event().wait()


def test_a_task_that_ignores_cancellation_is_named_and_cancelled_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def idle(*handlers: object) -> None:  # the real API would be disturbed in its last responses
        await asyncio.Event().wait()

    monkeypatch.setattr(lifecycle, "CANCEL_AGAIN_S", 0.05)

    async def extra_task_body(service: Any) -> None:
        asyncio.get_running_loop().call_later(0.01, os.kill, os.getpid(), signal.SIGTERM)
        await one_that_stays()

    async def main() -> None:
        async with asyncio.timeout(30.0):
            config = parse_config({"state": {"directory": str(tmp_path)}}, where="test", sim=True)
            await root.run(config, lambda _: idle, world=World(WorldSettings(), seed=0), extra_task=extra_task_body)

    structlog.reset_defaults()
    with capture_logs() as reported:
        asyncio.run(main())
    (line,) = [line for line in reported if "cancelled again" in line["event"]]
    assert "extra" in line["tasks"]
    assert reported[-1]["event"] == "slipguard stops; the grip stays as it is"


async def test_without_a_thread_for_it_the_kernel_ends_a_hanging_process(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(thread: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    asyncio.get_running_loop().add_signal_handler(signal.SIGALRM, lambda: None)
    monkeypatch.setattr(threading.Timer, "start", refuse)
    try:
        lifecycle.exit_if_stuck()
        assert signal.getsignal(signal.SIGALRM) is signal.SIG_DFL
    finally:
        remaining_s = signal.alarm(0)
    assert 0 < remaining_s <= lifecycle.EXIT_S


def test_systemd_waits_longer_for_the_end_than_the_daemon() -> None:
    unit = (Path(__file__).parents[2] / "systemd" / "slipguard.service").read_text()
    (stop_s,) = (float(line.partition("=")[2]) for line in unit.splitlines() if line.startswith("TimeoutStopSec="))
    assert lifecycle.CANCEL_AGAIN_S < lifecycle.EXIT_S < lifecycle.EXIT_S + lifecycle.FLUSH_S < stop_s


def test_requests_to_a_stopping_service_are_refused() -> None:
    async def main() -> None:
        cell = Cell()
        async with running(cell):
            await cell.ready()
            asked = [asyncio.create_task(cell.submit(GraspRequest())) for _ in range(3)]
            await asyncio.sleep(0)
        ends = await asyncio.gather(*asked, return_exceptions=True)
        assert str(ends[0]).startswith("closing")
        assert [str(end) for end in ends[1:]] == 2 * ["grasp: slipguard is stopping"]

    run_virtual(main())
