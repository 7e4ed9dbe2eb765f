"""A cell as it is switched on: the gripper is not activated, and only a request activates it."""

from __future__ import annotations

import asyncio

import pytest
from loop_cell import Cell, play

from slipguard.control.state import Phase
from slipguard.daemon.api import handlers
from slipguard.daemon.api.requests import ActivateRequest, GraspRequest, MoveJawsRequest
from slipguard.errors import CommandRefused, DeviceTimeout
from slipguard.sim.world import World, WorldSettings

CONFIRMED = ActivateRequest(confirm=True)


def switched_on() -> Cell:
    return Cell(world=World(WorldSettings(step_s=2e-3, gripper_activated=False)), watched=False)


def test_from_switched_on_to_activated() -> None:
    async def scene(cell: Cell) -> None:
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

    play(switched_on(), scene)


def test_refused_while_an_object_is_held_and_the_gripper_was_switched_off_and_on() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        assert cell.world is not None
        cell.world.gripper_activated = False
        await cell.until(lambda: cell.phase is Phase.FAULT)
        with pytest.raises(CommandRefused, match="would drop"):
            await cell.submit(CONFIRMED)
        await asyncio.sleep(1.0)
        assert cell.truth.in_contact

    play(Cell(), scene)


def test_refused_while_a_finger_sees_contact_unless_the_gels_are_covered() -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        for perceiver in cell.perceivers["left"]:
            perceiver.always_touched = True
        await asyncio.sleep(0.2)
        with pytest.raises(CommandRefused, match="left finger is in contact"):
            await cell.submit(CONFIRMED)
        assert cell.width_mm == 85.0
        await cell.submit(ActivateRequest(confirm=True, force=True))

    play(switched_on(), scene)


def test_a_failed_activation_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()

        async def fails() -> None:
            raise DeviceTimeout("gripper: not activated after 10 s (activation fault)")

        monkeypatch.setattr(cell.gripper, "activate", fails)
        monkeypatch.setattr(cell.service.gripper, "_poll_s", 0.2)
        with pytest.raises(CommandRefused, match="the activation failed: gripper: not activated after 10 s"):
            await cell.submit(CONFIRMED)

        async def nothing() -> None:
            await asyncio.sleep(0)

        await cell.ready()
        monkeypatch.setattr(cell.gripper, "activate", nothing)
        with pytest.raises(CommandRefused, match=f"not activated within {handlers.ACTIVATED_WITHIN_S:g} s"):
            await cell.submit(CONFIRMED)

    play(switched_on(), scene)
