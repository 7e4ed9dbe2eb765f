"""Hours of holding in short: noise tightens nothing, memory stays constant, a busy machine skips and counts cycles."""

from __future__ import annotations

import asyncio
import sys
import threading

import numpy as np
import pytest
from loop_cell import Cell, play, running

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import ClearRequest, GuardRequest
from slipguard.daemon.loop.actuator import ROUND_TRIPS
from slipguard.daemon.loop.event_log import KEPT


@pytest.mark.campaign
@pytest.mark.parametrize("minutes", [1, 5])
def test_minutes_of_holding_neither_tighten_nor_grow(minutes: int) -> None:
    """6,000 cycles of 10 ms a minute. Frames at 30 a second and a slow poll keep it cheap."""

    async def scene(cell: Cell) -> None:
        await cell.grasp()
        await cell.lift()
        await cell.until(cell.steady)
        await asyncio.sleep(5.0 + 0.1 * ROUND_TRIPS)  # until the newest round trips are all there
        count, size, lines = len(cell.gripper.commands), weight(cell), len(cell.service.event_log.lines)
        ended_s = cell.now_s + 60.0 * minutes
        while cell.now_s < ended_s:
            await asyncio.sleep(30.0)
            assert weight(cell) <= size + 2000
        assert len(cell.gripper.commands) == count
        assert cell.phase is Phase.HOLDING
        assert cell.service.deadlines_missed == 0
        assert len(cell.service.event_log.lines) == lines

    cell = Cell("wrench", 1, loop={"poll_ms": 100.0}, fps=30.0, watched=False)
    play(cell, scene)
    assert cell.ticks > 6_000 * minutes


def weight(cell: Cell) -> int:
    """Bytes of what the service holds on to, roughly: every object reached from it, except arrays and modules."""
    seen: set[int] = set()
    todo: list[object] = [
        cell.service._control_state,
        cell.service.event_log.lines,
        cell.service.observation,
        *vars(cell.service).values(),
    ]
    total = 0
    while todo:
        one = todo.pop()
        if id(one) in seen or isinstance(one, (type, np.ndarray)) or callable(one):
            continue
        seen.add(id(one))
        total += sys.getsizeof(one)
        if isinstance(one, dict):
            todo += [*one.keys(), *one.values()]
        elif isinstance(one, (list, tuple, set, frozenset)):
            todo += list(one)
        elif type(one).__module__.startswith("slipguard.daemon") or type(one).__module__.startswith(
            "slipguard.control"
        ):
            names = getattr(one, "__slots__", None) or vars(one)
            todo += [getattr(one, name) for name in names if hasattr(one, name)]
    return total


def test_the_number_of_kept_messages_is_limited() -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        for on in [False, True] * 40:
            await cell.submit(GuardRequest(on=on))
        assert len(cell.service.event_log.lines) == KEPT

    play(Cell(guard={"mode": "guard"}), scene)


def test_the_newest_frame_wins_when_the_worker_is_slow() -> None:
    async def scene(cell: Cell) -> None:
        await cell.ready()
        judged: dict[str, list[int]] = {"left": [], "right": []}
        cell.service.observers.append(
            lambda decision: [judged[name].append(one.sequence) for name, one in decision.new_estimates.items()]
        )
        await asyncio.sleep(2.0)
        for name, finger in cell.service.fingers.items():
            steps = np.diff(judged[name])
            assert (steps >= 3).all()  # 50 ms of work, a frame every 16.7 ms
            assert (steps <= 5).all()
            assert finger.capture.counts.late > 50
            assert finger.captured_at_s is not None
            assert cell.now_s - finger.captured_at_s < 0.17

    play(Cell(latency_s=0.05), scene)


def test_an_estimate_computed_during_a_reset_of_the_reference_is_dropped() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        finger, oracle = cell.service.fingers["left"], cell.perceivers["left"][0]
        await cell.until(lambda: finger.newest is not None and finger.newest.estimate.sequence < oracle.sequence)
        under_way = oracle.sequence
        finger.reset_reference()
        assert finger.newest is None
        await finger.has_estimate.wait()
        assert finger.newest is not None
        assert finger.newest.estimate.sequence > under_way
        assert finger.newest.estimate.rotation_deg is None

    play(Cell("wrench", 1, latency_s=0.03), scene)


def test_a_blocked_loop_counts_missed_ticks_and_does_not_burst() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        beats: list[float] = []
        loop = asyncio.get_running_loop()
        loop._jumping.now_s += 0.155  # type: ignore[attr-defined]
        cell.service.observers.append(lambda decision: beats.append(decision.now_s))
        await asyncio.sleep(0.1)
        assert cell.service.deadlines_missed in (14, 15)
        assert len(beats) < 30
        assert cell.phase is Phase.HOLDING

    play(Cell("wrench", 1), scene)


def test_a_loop_blocked_for_long_is_a_fault() -> None:
    async def scene(cell: Cell) -> None:
        await cell.grasp()
        loop = asyncio.get_running_loop()
        loop._jumping.now_s += 0.7  # type: ignore[attr-defined]
        await cell.until(lambda: cell.phase is Phase.FAULT)
        assert cell.truth.in_contact
        await asyncio.sleep(0.5)
        await cell.submit(ClearRequest())

    play(Cell("wrench", 1), scene)


async def test_on_the_real_clock_with_threads_it_grips_and_ends_its_threads() -> None:
    others = set(threading.enumerate())  # threads of an earlier test may not have ended yet
    cell = Cell(
        "key",
        1,
        guard={"tuning": {"reference_timeout_s": 5.0, "frames_timeout_s": 5.0, "cycle_timeout_s": 5.0}},
        threads=True,
    )
    async with running(cell):
        await cell.grasp()
        names = {thread.name for thread in threading.enumerate()}
        assert any(name.startswith("slipguard-left") for name in names)
        assert cell.truth.in_contact
    assert cell.truth.in_contact
    assert not [one for one in set(threading.enumerate()) - others if one.name.startswith("slipguard-")]
