"""Log of the true states of an emulated cell, as JSON lines. It serves to evaluate slipguard, which never reads it."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Callable
from pathlib import Path

from slipguard.sim.world import World, WorldTruth

STEP_S = 0.01
QUIET_S = 1.0
"""Time between lines while nothing changes."""


def line_of(truth: WorldTruth) -> dict[str, object]:
    """Return one line. Angles in degrees in the left image, forces in newtons per finger; t is CLOCK_MONOTONIC."""
    return {
        "t": round(truth.time_s, 4),
        "object": truth.object_name,
        "rotation": round(truth.rotation_deg, 3),
        "slip": round(truth.slip_deg, 3),
        "slip_mm": round(truth.slip_mm, 3),
        "force": round(truth.force_n, 2),
        "needed": round(truth.needed_force_n, 2),
        "height": round(truth.height_mm, 2),
        "in_contact": truth.in_contact,
        "on_table": truth.on_table,
        "dropped": truth.dropped,
    }


class CellTruthLog:
    """Writes a line when something changes. on_drop: called with the reason, once for each dropped object."""

    def __init__(self, world: World, path: Path, on_drop: Callable[[str], None]) -> None:
        self._world = world
        self._path = path
        self._on_drop = on_drop

    async def run(self) -> None:
        """Write until cancelled."""
        loop = asyncio.get_running_loop()
        before: dict[str, object] = {}
        written_s, dropped = 0.0, None
        with self._path.open("w", buffering=1) as file:
            due_s = loop.time()
            while True:
                due_s = max(due_s + STEP_S, loop.time())
                await asyncio.sleep(due_s - loop.time())
                truth = self._world.truth(loop.time())
                line = line_of(truth)
                if {**line, "t": None} != before or loop.time() - written_s > QUIET_S:
                    before, written_s = {**line, "t": None}, loop.time()
                    file.write(json.dumps(line) + "\n")
                if truth.dropped is not None and dropped is None:
                    self._on_drop(truth.dropped)
                dropped = truth.dropped
