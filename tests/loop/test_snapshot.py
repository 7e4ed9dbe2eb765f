"""The service's latency statistics: frame rates, ages and latencies are those of the cell."""

from __future__ import annotations

import asyncio
import json
from typing import Any

import pytest
from loop_cell import Cell, play


def test_the_state_has_rates_ages_and_latencies() -> None:
    snapshots: dict[str, Any] = {}

    async def scene(cell: Cell) -> None:
        await cell.grasp()
        await asyncio.sleep(3.0)
        snapshots["steady"] = json.loads(json.dumps(cell.handlers.snapshot()))
        assert cell.world is not None
        cell.world.faults.fail("left", "stall")
        await asyncio.sleep(3.0)
        snapshots["stalled"] = json.loads(json.dumps(cell.handlers.snapshot()))
        snapshots["now_s"] = cell.now_s

    play(Cell("wrench", 1, guard={"force_max_n": 120.0}, fps=30.0, latency_s=0.006), scene)
    steady, stalled = snapshots["steady"], snapshots["stalled"]
    assert steady["limits"] == {"first_force_n": 40.0, "force_max_n": 120.0, "lift_height_mm": 100.0}
    for finger in steady["fingers"].values():
        assert finger["frames_per_s"] == pytest.approx(30.0, abs=1.5)
        assert 0.02 < finger["age_s"] < 0.12
    assert steady["latency"]["p50_ms"] == pytest.approx(6.0, abs=1.0)
    assert steady["latency"]["p50_ms"] <= steady["latency"]["p99_ms"] < 20.0
    assert snapshots["now_s"] - 0.02 <= stalled["now_s"] <= snapshots["now_s"]
    assert stalled["fingers"]["left"]["frames_per_s"] == 0.0
    assert stalled["fingers"]["left"]["age_s"] > 2.0
    assert stalled["fingers"]["right"]["frames_per_s"] > 20.0
