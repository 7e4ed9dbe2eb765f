"""Requests are answered or refused in time, and a command that the gripper missed is sent again."""

from __future__ import annotations

import asyncio
import itertools

import pytest
from loop_cell import Cell, on_cell

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import GraspRequest, LiftRequest, ReleaseRequest
from slipguard.daemon.loop.virtual_time import VirtualTimeLoop
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.errors import CommandRefused, DeviceTimeout


@on_cell()
async def test_a_grip_that_was_not_taken_is_commanded_again(cell: Cell) -> None:
    await cell.ready()
    cell.gripper.failures = [DeviceTimeout("gripper: no answer within 50 ms")] * 2
    await cell.grasp()
    assert [what for _, what, _ in cell.gripper.commands] == ["hold"] * 3
    times_s = [sent_s for sent_s, _, _ in cell.gripper.commands]
    assert max(later - earlier for earlier, later in itertools.pairwise(times_s)) < 0.2


@on_cell("wrench", 1)
async def test_a_tightening_that_was_not_taken_is_commanded_again(cell: Cell) -> None:
    await cell.grasp()
    cell.gripper.failures = [DeviceTimeout("gripper: no answer within 50 ms")]
    before = len(cell.gripper.commands)
    await cell.lift()
    assert cell.gripper.failures == []
    holds = [value for _, what, value in cell.gripper.commands[before:] if what == "hold"]
    assert holds[0] == holds[1]
    assert cell.truth.applied_n == pytest.approx(cell.service.state.grip.target_n, abs=0.5)
    assert cell.truth.dropped is None


@on_cell()
async def test_a_release_that_was_not_taken_is_commanded_again(cell: Cell) -> None:
    await cell.grasp()
    cell.gripper.failures = [DeviceTimeout("gripper: no answer within 50 ms")]
    await cell.release()
    assert [what for _, what, _ in cell.gripper.commands].count("release") == 2
    assert cell.width_mm == pytest.approx(85.0, abs=0.5)


@on_cell()
async def test_a_request_that_times_out_is_refused_and_not_carried_out_later(cell: Cell) -> None:
    await cell.ready()
    run_cycle = cell.service._run_cycle
    cell.service._run_cycle = lambda now_s: None  # type: ignore[method-assign]
    asked_s = cell.now_s
    with pytest.raises(CommandRefused, match="grasp: the loop did not respond within 2 s"):
        await cell.service.request(ControlRequest(RequestKind.GRASP))
    assert cell.now_s - asked_s == pytest.approx(2.0, abs=0.02)
    cell.service._run_cycle = run_cycle  # type: ignore[method-assign]
    await asyncio.sleep(0.5)
    assert cell.phase is Phase.IDLE
    assert cell.gripper.commands == []


@on_cell()
async def test_a_command_given_while_the_arm_is_away_is_not_obeyed_when_it_returns(cell: Cell) -> None:
    await cell.grasp()
    cell.world.faults.fail("arm", "timeout")
    await asyncio.sleep(0.05)
    await cell.submit(LiftRequest())  # the arm does not answer, but its newest state is recent
    cell.world.faults.fail("arm", "disconnect")
    await asyncio.sleep(3.0)
    cell.world.faults.repair("arm")
    await cell.until(lambda: not cell.service.waiting_for)
    await asyncio.sleep(2.0)
    assert cell.truth.height_mm == 0.0
    assert cell.phase is Phase.FAULT


@on_cell()
async def test_a_grasp_whose_preparation_outlasts_its_client_does_not_close_the_jaws(cell: Cell) -> None:
    """Slow storage: 6 s for each background image, while the client gives up after 5 s."""
    await cell.ready()
    load = cell.store.load_background

    def read_slowly(serial: str, number: int | None = None) -> BackgroundImage | None:
        loop = asyncio.get_running_loop()
        assert isinstance(loop, VirtualTimeLoop)
        loop.stand_still(6.0)
        return load(serial, number)

    cell.store.load_background = read_slowly  # type: ignore[method-assign]
    with pytest.raises(CommandRefused, match=r"grasp.*(not executed|not read within 4 s)"):
        await cell.submit(GraspRequest())
    await asyncio.sleep(10.0)
    assert cell.gripper.commands == []
    assert cell.phase is Phase.IDLE


@pytest.mark.parametrize("request_kind", [RequestKind.GRASP, RequestKind.RELEASE])
@on_cell()
async def test_a_request_in_the_queue_of_a_suspended_process_is_not_executed_afterwards(
    cell: Cell, request_kind: RequestKind
) -> None:
    await cell.ready()
    loop = asyncio.get_running_loop()
    assert isinstance(loop, VirtualTimeLoop)
    asked = asyncio.create_task(cell.service.request(ControlRequest(request_kind)))
    await asyncio.sleep(0)
    loop.stand_still(6.0)
    with pytest.raises(CommandRefused, match="did not respond within 2 s; not executed"):
        await asked
    await asyncio.sleep(1.0)
    assert cell.gripper.commands == []


@on_cell()
async def test_a_release_behind_a_grasp_is_executed_and_a_second_grasp_refused(cell: Cell) -> None:
    await cell.ready()
    asked_s = cell.now_s
    first, second = await asyncio.gather(cell.submit(GraspRequest()), cell.submit(ReleaseRequest(confirm=True)))
    assert first.startswith("closing with")
    assert second.startswith("releasing, as requested")
    assert cell.now_s - asked_s < 0.05
    await cell.until(lambda: cell.phase is Phase.IDLE)
    twice = await asyncio.gather(cell.submit(GraspRequest()), cell.submit(GraspRequest()), return_exceptions=True)
    assert str(twice[0]).startswith("closing with")
    assert str(twice[1]) == "cannot grasp while closing; support the object, then release it"


@on_cell()
async def test_slow_storage_is_named_before_the_client_gives_up(cell: Cell) -> None:
    await cell.ready()
    asked_s = cell.now_s
    cell.handlers._capture.check_calibrated = lambda: asyncio.sleep(6.0)  # type: ignore[method-assign]
    with pytest.raises(CommandRefused, match="cannot grasp: the background images were not read within 4 s"):
        await cell.submit(GraspRequest())
    assert cell.now_s - asked_s < GraspRequest.response_timeout_s
    await asyncio.sleep(10.0)
    assert cell.gripper.commands == []
