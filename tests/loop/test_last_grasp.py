"""The force of a grip survives the daemon: noted down as it changes, forgotten with the object."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from loop_cell import Cell, play

from slipguard.daemon.decision import Decision
from slipguard.daemon.disk_work import TRY_AGAIN_S
from slipguard.daemon.last_grasp import GraspKeeper, remembered
from slipguard.daemon.state_dir import LastGrasp, StateDir
from slipguard.errors import ConfigError
from slipguard.grasp.guard import Guard
from slipguard.grasp.state import GuardState, Remembered


def test_the_grip_is_noted_down_tightened_and_forgotten(tmp_path: Path) -> None:
    shelf = StateDir(tmp_path)

    async def scene(cell: Cell) -> None:
        cell.service.observers.append(GraspKeeper(shelf, cell.says.append).decided)
        await cell.grasp()
        await asyncio.sleep(0.1)
        first = shelf.load_last_grasp()
        assert first is not None
        assert first.force_n == cell.service.state.target_n
        await cell.lift()
        await asyncio.sleep(0.5)
        tightened = shelf.load_last_grasp()
        assert tightened is not None
        assert tightened.force_n == cell.service.state.target_n > first.force_n
        assert remembered(shelf).law.remembered == Remembered(tightened.force_n, tightened.width_mm)
        await cell.lower()
        await cell.release()
        await asyncio.sleep(0.1)
        assert shelf.load_last_grasp() is None

    play(Cell("wrench", 1), scene)


def test_a_grip_that_does_not_change_for_hours_does_not_grow_old(tmp_path: Path) -> None:
    class Counting(StateDir):
        writes = 0

        def save_last_grasp(self, last: LastGrasp) -> None:
            self.writes += 1
            super().save_last_grasp(last)

    shelf = Counting(tmp_path)

    async def scene(cell: Cell) -> None:
        keeper = GraspKeeper(shelf, cell.says.append)
        decisions: list[Decision] = []
        cell.service.observers.append(decisions.append)
        await cell.grasp()
        held = decisions[-1]
        for minutes in range(0, 21, 4):
            keeper.decided(replace(held, now_s=held.now_s + 60.0 * minutes))
            await asyncio.sleep(0.1)
        assert shelf.writes == 3, "at 0, 8 and 16 minutes"

    play(Cell("wrench", 1), scene)


def test_a_disk_that_fails_is_said_and_keeps_nothing_from_going_on() -> None:
    class Full:
        def save_last_grasp(self, last: LastGrasp) -> None:
            raise ConfigError("last_grasp.json: cannot be written (No space left on device)")

        def load_last_grasp(self) -> LastGrasp | None:
            return None

        def forget_last_grasp(self) -> None:
            raise OSError(30, "Read-only file system")

    said: list[str] = []

    async def scene(cell: Cell) -> None:
        cell.service.observers.append(GraspKeeper(Full(), said.append).decided)
        await cell.grasp()
        await asyncio.sleep(0.2)

    play(Cell("wrench", 1), scene)
    assert any("No space left" in line for line in said)
    assert len(said) <= 3


def test_a_disk_that_is_mended_gets_the_grip_though_the_force_has_not_changed(tmp_path: Path) -> None:
    class Mended(StateDir):
        writes = 0

        def save_last_grasp(self, last: LastGrasp) -> None:
            self.writes += 1
            if self.writes <= 2:
                raise ConfigError("last_grasp.json: cannot be written (No space left on device)")
            super().save_last_grasp(last)

    shelf, said = Mended(tmp_path), list[str]()

    async def scene(cell: Cell) -> None:
        cell.service.observers.append(GraspKeeper(shelf, said.append).decided)
        await cell.grasp()
        await cell.until(lambda: shelf.writes > 0)
        before, force_n = shelf.writes, cell.service.state.target_n
        await asyncio.sleep(1.0)
        assert (shelf.writes, before) == (1, 1), "not at once again"
        await asyncio.sleep(3 * TRY_AGAIN_S)
        last = shelf.load_last_grasp()
        assert last is not None
        assert last.force_n == force_n == cell.service.state.target_n

    play(Cell("wrench", 1), scene)
    assert [line.partition(" for a restart")[0] for line in said] == [
        "the grip could not be noted down",
        "the grip can be noted down",
    ]


@pytest.mark.parametrize("content", ['{"format": 1}', "not JSON", '{"format": 3, "force_n": "NaN"}'])
def test_a_damaged_note_counts_as_none(tmp_path: Path, content: str) -> None:
    (tmp_path / "last_grasp.json").write_text(content)
    assert remembered(StateDir(tmp_path)) == Guard()


def test_an_old_note_counts_as_none(tmp_path: Path) -> None:
    shelf, now = StateDir(tmp_path), datetime.now(UTC)
    shelf.save_last_grasp(LastGrasp(saved_at=now - timedelta(hours=2), force_n=90.0, width_mm=18.0))
    assert remembered(shelf, now) == Guard()
    shelf.save_last_grasp(LastGrasp(saved_at=now - timedelta(minutes=2), force_n=90.0, width_mm=18.0))
    assert remembered(shelf, now) == Guard(GuardState(remembered=Remembered(90.0, 18.0)))


def test_a_stop_for_a_person_is_remembered_until_the_arm_is_heard(tmp_path: Path) -> None:
    """So that a daemon that starts with somebody in the jaws adds no force before it knows that they are gone."""
    shelf = StateDir(tmp_path)

    async def scene(cell: Cell) -> None:
        assert cell.world is not None
        cell.service.observers.append(GraspKeeper(shelf, cell.says.append).decided)
        await cell.grasp()
        cell.world.faults.fail("arm", "protective_stop")
        await asyncio.sleep(0.3)
        assert remembered(shelf).law.person_near
        cell.world.faults.mend("arm")
        await asyncio.sleep(0.3)
        assert not remembered(shelf).law.person_near

    play(Cell("wrench", 1), scene)
