"""Fingertip sensors that meet early: with their thickness configured, gel never presses on gel."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from loop_cell import Cell, on_cell, play

from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest, DaemonRequest, GraspRequest, MoveJawsRequest
from slipguard.errors import CommandRefused
from slipguard.tools.fingertips import FingertipMeasurement, describe

TIP_MM = 15.0


def holds(cell: Cell) -> list[float]:
    return [value for _, what, value in cell.gripper.commands if what == "hold"]


async def take_away(cell: Cell) -> None:
    cell.world.clear(cell.now_s)


@pytest.mark.parametrize("error_mm", [0.0, 0.4, -0.4], ids=["right", "too thick", "too thin"])
def test_a_grasp_of_nothing_closes_on_nothing_and_the_gels_stay_apart(error_mm: float) -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        await take_away(cell)
        await cell.submit(GraspRequest())
        await cell.until(lambda: cell.phase is not Phase.CLOSING)
        await asyncio.sleep(0.5)
        assert cell.phase is Phase.IDLE
        assert "the gripper closed on nothing" in cell.messages
        assert not cell.truth.in_contact
        await cell.submit(MoveJawsRequest(width_mm=30.0))
        await cell.until(lambda: cell.service.gripper.newest is not None and cell.service.gripper.newest.width_mm > 29)

    play(Cell(fingertip_mm=TIP_MM, configured_mm=TIP_MM + error_mm, watched=False), scene)


@pytest.mark.parametrize("error_mm", [0.0, -0.7], ids=["right", "too thin"])
def test_after_a_loss_the_gels_are_not_tightened(error_mm: float) -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        await cell.lift()
        before = len(holds(cell))
        await take_away(cell)
        await cell.faulted(FaultCode.OBJECT_LOST)
        await asyncio.sleep(3.0)
        assert len(holds(cell)) == before, "no command tightens gel on gel"
        if not error_mm:
            assert not cell.truth.in_contact
        await cell.submit(ClearRequest())
        assert cell.phase is Phase.IDLE

    play(Cell("wrench", fingertip_mm=TIP_MM, configured_mm=TIP_MM + error_mm, watched=False), scene)


async def measure(cell: Cell, widths: list[float]) -> float | None:
    """Measure, from jaws that are nearly closed already."""
    gripper = cell.service.gripper.newest
    if cell.phase is Phase.IDLE and gripper is not None and gripper.active:
        await cell.submit(MoveJawsRequest(width_mm=(cell.configured_mm == 0.0) * 2 * TIP_MM + 6.0))
        await asyncio.sleep(1.0)

    async def state() -> dict[str, Any]:
        return dict(json.loads(await cell.handlers.state()))

    async def submit(request: DaemonRequest) -> None:
        await cell.handlers.submit(request)

    return await FingertipMeasurement(state, submit, widths.append).run()


@pytest.mark.parametrize("mode", ["lift", "guard"])
def test_the_measurement_finds_where_the_gels_touch_and_opens_again(mode: str) -> None:
    widths: list[float] = []

    async def scene(cell: Cell) -> None:
        await cell.ready()
        await take_away(cell)
        touch_mm = await measure(cell, widths)
        assert touch_mm == pytest.approx(2 * TIP_MM, abs=0.8)
        assert touch_mm >= 2 * TIP_MM, "rather too thick"
        assert max(cell.truth.force_n, *(value for value in holds(cell)), 0.0) == 0.0
        assert not cell.truth.in_contact
        assert cell.phase is Phase.IDLE
        assert f"fingertip_mm = {touch_mm / 2:.1f}" in describe(touch_mm)

    cell = play(Cell(fingertip_mm=TIP_MM, configured_mm=0.0, watched=False, guard={"mode": mode}), scene)
    assert widths[0] > 2 * TIP_MM + 5.0
    moves = [value for _, what, value in cell.gripper.commands if what == "move"]
    assert len(moves) == 1 + len(widths)


@on_cell(watched=False)
async def test_the_measurement_needs_empty_jaws_and_both_fingers(cell: Cell) -> None:
    await cell.grasp()
    with pytest.raises(CommandRefused, match="support what they hold, then release"):
        await measure(cell, [])
    assert cell.truth.in_contact
    await cell.release()
    await take_away(cell)
    cell.world.faults.fail("left", "disconnect")
    await cell.until(lambda: bool(cell.service.waiting_for))
    with pytest.raises(CommandRefused, match="left is not ready"):
        await measure(cell, [])
