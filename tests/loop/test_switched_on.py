"""A cell as it is switched on: the gripper is not activated, and only a request activates it."""

from __future__ import annotations

import asyncio
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from loop_cell import Cell, on_cell

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ActivateRequest, GraspRequest, MoveJawsRequest, ReleaseRequest
from slipguard.daemon.store.last_grasp import LastGraspSaver, restore_control_state
from slipguard.daemon.store.state_dir import LastGrasp, StateDir
from slipguard.errors import CommandRefused, DeviceTimeout
from slipguard.sim.world import World, WorldSettings

CONFIRMED = ActivateRequest(confirm=True)


def switched_on() -> Cell:
    return Cell(world=World(WorldSettings(step_s=2e-3, gripper_activated=False)), watched=False)


@on_cell(make=switched_on)
async def test_from_switched_on_to_activated(cell: Cell) -> None:
    await cell.ready()
    for request in (GraspRequest(), MoveJawsRequest(width_mm=50.0)):
        with pytest.raises(CommandRefused, match="run `slipguard ctl activate`"):
            await cell.submit(request)
    assert cell.width_mm == 85.0, "nothing has moved"
    activation = asyncio.ensure_future(cell.submit(CONFIRMED))
    await cell.until(lambda: cell.width_mm < 1.0)
    with pytest.raises(CommandRefused, match="not activated"):
        await cell.submit(GraspRequest())
    assert "activated; the jaws are 85 mm apart" in await activation
    with pytest.raises(CommandRefused, match="already activated"):
        await cell.submit(CONFIRMED)
    await cell.submit(MoveJawsRequest(width_mm=50.0))
    await cell.until(lambda: cell.width_mm < 51.0)


@on_cell()
async def test_refused_while_an_object_is_held_and_the_gripper_was_switched_off_and_on(cell: Cell) -> None:
    await cell.grasp()
    cell.world.gripper_activated = False
    await cell.until(lambda: cell.phase is Phase.FAULT)
    with pytest.raises(CommandRefused, match="would close on a held object and drop it"):
        await cell.submit(CONFIRMED)
    await asyncio.sleep(1.0)
    assert cell.truth.in_contact
    width_mm, force_n = cell.width_mm, cell.truth.force_n
    await cell.submit(ReleaseRequest(confirm=True))
    while cell.phase is not Phase.IDLE:
        await asyncio.sleep(0.01)
        assert cell.width_mm >= width_mm
        assert cell.truth.force_n <= force_n
        width_mm, force_n = cell.width_mm, cell.truth.force_n
    assert width_mm == 85.0
    assert "must be activated" in cell.service.event_log.lines[-1]
    cell.world.clear(cell.now_s)
    assert "activated" in str(await cell.submit(CONFIRMED))
    await cell.submit(MoveJawsRequest(width_mm=50.0))


@pytest.mark.parametrize("damaged", [False, True])
@on_cell(make=switched_on)
async def test_refused_after_a_start_with_an_old_or_damaged_file_until_the_gripper_was_active(
    cell: Cell, tmp_path: Path, damaged: bool
) -> None:
    store, path = StateDir(tmp_path), tmp_path / "last_grasp.json"
    store.save_last_grasp(LastGrasp(saved_at=datetime.now(UTC) - timedelta(days=1), force_n=90.0, width_mm=18.0))
    if damaged:
        path.write_text(path.read_text()[:60])
    cell.service._control_state = restore_control_state(store)
    cell.service.observers.append(LastGraspSaver(store, cell.messages.append, cell.messages.append).add_decision)
    await cell.ready()
    await asyncio.sleep(0.2)
    with pytest.raises(CommandRefused, match="something was held before the last start, or may have been"):
        await cell.submit(CONFIRMED)
    assert path.exists()
    await cell.submit(ActivateRequest(confirm=True, force=True))
    await asyncio.sleep(0.2)
    assert not cell.service.state.adoption.outdated
    assert store.load_last_grasp() is None


@on_cell(make=switched_on)
async def test_refused_while_a_finger_sees_or_may_see_contact_unless_that_is_known_better(cell: Cell) -> None:
    with pytest.raises(CommandRefused, match="no sensor was found yet for the left finger"):
        await cell.submit(CONFIRMED)
    await cell.ready()
    cell.perceivers["left"][-1].always_touched = True
    await asyncio.sleep(0.2)
    with pytest.raises(CommandRefused, match="left finger is in contact"):
        await cell.submit(CONFIRMED)
    cell.perceivers["left"][-1].always_touched = False
    cell.world.faults.fail("right", "disconnect")
    await asyncio.sleep(1.0)
    with pytest.raises(CommandRefused, match="right finger has no recent estimate"):
        await cell.submit(CONFIRMED)
    assert cell.width_mm == 85.0
    await cell.submit(ActivateRequest(confirm=True, force=True))


@on_cell(make=switched_on)
async def test_a_failed_activation_is_reported(cell: Cell, monkeypatch: pytest.MonkeyPatch) -> None:
    async def fails() -> None:
        raise DeviceTimeout("gripper: not activated after 10 s (activation fault)")

    async def succeeds_late() -> None:
        await asyncio.sleep(3.0)
        cell.world.gripper_activated = True

    async def never_ends() -> None:
        await asyncio.sleep(0)

    await cell.ready()
    monkeypatch.setattr(cell.gripper, "activate", fails)
    monkeypatch.setattr(cell.service.gripper, "_poll_s", 0.2)
    with pytest.raises(CommandRefused, match="the activation failed: gripper: not activated after 10 s"):
        await cell.submit(CONFIRMED)
    assert not cell.service.gripper.health.ready, "of the command before"
    monkeypatch.setattr(cell.gripper, "activate", succeeds_late)
    assert "is activated" in await cell.submit(CONFIRMED)
    cell.world.gripper_activated = False
    await asyncio.sleep(0.5)
    monkeypatch.setattr(cell.gripper, "activate", never_ends)
    with pytest.raises(CommandRefused, match="not activated within 15 s; the jaws may still move"):
        await cell.submit(CONFIRMED)
