"""The service's state: frame rates, ages and latencies are those of the cell. Every estimate is streamed."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest
from loop_cell import Cell, play

from slipguard.daemon.api.state import NewEstimates


def test_the_state_has_rates_ages_and_latencies() -> None:
    snapshots: dict[str, Any] = {}
    received: list[NewEstimates] = []

    async def scene(cell: Cell) -> None:
        await cell.grasp()
        unsubscribe = cell.handlers.subscribe_estimates(
            lambda new: received.append(NewEstimates.model_validate_json(new))
        )
        await asyncio.sleep(3.0)
        unsubscribe()
        snapshots["steady"] = cell.handlers.snapshot().model_dump(mode="json")
        assert cell.world is not None
        cell.world.faults.fail("left", "stall")
        await asyncio.sleep(3.0)
        snapshots["stalled"] = cell.handlers.snapshot().model_dump(mode="json")
        snapshots["now_s"] = cell.now_s

    play(Cell("wrench", 1, guard={"force_max_n": 120.0}, fps=30.0, latency_s=0.006), scene)
    steady, stalled = snapshots["steady"], snapshots["stalled"]
    assert steady["limits"] == {
        "first_force_n": 40.0,
        "force_max_n": 120.0,
        "rotation_max_deg": 45.0,
        "lift_height_mm": 100.0,
    }
    assert [new.number for new in received] == list(range(len(received)))
    for finger in ("left", "right"):
        times_s = [new.fingers[finger].captured_at_s for new in received if finger in new.fingers]
        assert len(times_s) == pytest.approx(90, abs=5)
        assert times_s == sorted(set(times_s))
    assert all(new.at_s - new.fingers[name].captured_at_s < 0.12 for new in received for name in new.fingers)
    assert received[-1].rotation is not None
    assert received[-1].rotation.rotation_deg is not None
    for finger in steady["fingers"].values():
        assert finger["frames_per_s"] == pytest.approx(30.0, abs=1.5)
        assert 0.02 < finger["age_s"] < 0.12
    assert steady["latency"]["p50_ms"] == pytest.approx(6.0, abs=1.0)
    assert steady["latency"]["p50_ms"] <= steady["latency"]["p99_ms"] < 20.0
    assert snapshots["now_s"] - 0.02 <= stalled["now_s"] <= snapshots["now_s"]
    assert stalled["fingers"]["left"]["frames_per_s"] == 0.0
    assert stalled["fingers"]["left"]["age_s"] > 2.0
    assert stalled["fingers"]["right"]["frames_per_s"] > 20.0
