"""Torn frames count as lost; a stream that keeps tearing them is restarted, one finger at a time."""

from __future__ import annotations

import asyncio
from dataclasses import replace

import pytest
from loop_cell import Cell, on_cell
from loop_doubles import Oracle

from slipguard.control.state import HeldObject, Phase, SlipEpisode
from slipguard.daemon.loop.capture import RESTART_APART_S, RESTART_INTERVAL_S, TORN_MAX
from slipguard.devices import Frame
from slipguard.errors import FrameTorn
from slipguard.perception.estimate import Estimate


def tear(oracle: Oracle, every: int) -> None:
    """From now on, refuse each `every`-th frame as torn."""
    process, count = oracle.process, [0]

    def maybe_torn(frame: Frame) -> Estimate:
        count[0] += 1
        if count[0] % every == 0:
            raise FrameTorn(f"frame {frame.sequence} is torn at column 120: its parts are from different captures")
        return process(frame)

    oracle.process = maybe_torn  # type: ignore[method-assign]


@on_cell("wrench", 1)
async def test_rare_tears_are_counted_and_restart_nothing(cell: Cell) -> None:
    await cell.grasp()
    tear(cell.perceivers["left"][-1], every=20)
    await asyncio.sleep(10.0)
    counts = cell.service.fingers["left"].capture.counts
    assert counts.torn == pytest.approx(30, abs=3)
    assert (counts.restarts, counts.corrupt, cell.sensors["left"].opened) == (0, 0, 1)
    assert cell.phase is Phase.HOLDING


@on_cell("wrench", 1)
async def test_repeated_tears_of_both_fingers_restart_the_streams_one_after_the_other(cell: Cell) -> None:
    await cell.grasp()
    assert cell.truth.dropped is None
    target_n = cell.service.state.grip.target_n
    for name in ("left", "right"):
        tear(cell.perceivers[name][-1], every=3)
    await asyncio.sleep(RESTART_APART_S + 1.5)
    for name in ("left", "right"):
        assert cell.service.fingers[name].capture.counts.restarts == 1
        assert cell.sensors[name].opened == 2
    await asyncio.sleep(RESTART_INTERVAL_S)
    assert cell.service.fingers["left"].capture.counts.restarts == 2
    assert cell.phase is Phase.HOLDING
    assert cell.service.state.grip.target_n == target_n
    assert "torn" in "\n".join(cell.service.event_log.lines)


@on_cell("wrench", 1)
async def test_no_stream_restarts_while_the_other_finger_has_no_frames_or_the_object_slips(cell: Cell) -> None:
    await cell.grasp()
    cell.world.faults.fail("right", "stall")
    tear(cell.perceivers["left"][-1], every=3)
    await asyncio.sleep(3.0)
    counts = cell.service.fingers["left"].capture.counts
    assert (counts.torn > TORN_MAX, counts.restarts) == (True, 0)
    assert cell.phase is Phase.HOLDING, "the left finger guards"
    memory, slip = cell.service._control_state, SlipEpisode(cell.now_s, cell.now_s)
    cell.world.faults.repair("right")
    await cell.until(lambda: cell.service._may_restart("left"))
    cell.service._control_state = replace(memory, grasp=replace(memory.grasp, held=HeldObject(slip=slip)))
    assert not cell.service._may_restart("left")
    cell.service._control_state = memory
    await cell.until(lambda: counts.restarts == 1)
