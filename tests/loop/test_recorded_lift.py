"""A lift recorded on the virtual clock: the law, played again on it, gives the very same commands."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path

from loop_cell import Cell, play

from slipguard.config import RecordingSection
from slipguard.daemon.recording import make_recorder, record
from slipguard.lab.replay import recordings, replay
from slipguard.recording import messages as m
from slipguard.recording.reader import Line


def recorded(cell: Cell, folder: Path, *, fail: str | None = None) -> Cell:
    without_pictures = RecordingSection(image="none")
    cell.service.config = cell.service.config.model_copy(update={"recording": without_pictures})

    async def scene(cell: Cell) -> None:
        recorder = make_recorder(cell.service, folder)
        task = asyncio.create_task(record(cell.service, recorder))
        await cell.grasp()
        if fail is not None:
            assert cell.world is not None
            cell.world.faults.fail("arm", fail)
            await asyncio.sleep(0.5)
        else:
            await cell.lift()
            await asyncio.sleep(0.5)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert recorder.left_out == 0
        assert recorder.stopped is None

    return play(cell, scene)


def test_a_lift_with_slip_is_kept_and_replays_to_the_same_commands(tmp_path: Path) -> None:
    cell = recorded(Cell("wrench", 1), tmp_path)
    assert any("tightening" in said for said in cell.says)
    played = replay(recordings([tmp_path / "kept"]))
    assert played.on_recorded.ticks > 200
    assert played.on_recorded.differences == []
    assert played.damage == []
    assert [phase for _, phase in played.phases] == ["idle", "closing", "reference", "holding", "lifting", "holding"]


def test_a_law_that_would_have_decided_otherwise_is_found_out(tmp_path: Path) -> None:
    recorded(Cell("wrench", 1), tmp_path)
    opened = recordings([tmp_path / "kept"])
    for one in opened:
        config = json.loads(one.attachments[m.CONFIG_ATTACHMENT])
        config["guard"]["first_step"] = 1.1
        one.attachments[m.CONFIG_ATTACHMENT] = json.dumps(config).encode()
    played = replay(opened)
    assert played.on_recorded.differences
    first = played.on_recorded.differences[0]
    assert first.recorded.hold_force_n is not None
    assert first.replayed.hold_force_n is not None
    assert first.replayed.hold_force_n < first.recorded.hold_force_n


def test_a_fault_is_kept_with_its_words(tmp_path: Path) -> None:
    recorded(Cell("wrench", 1), tmp_path, fail="protective_stop")
    opened = recordings([tmp_path / "kept"])
    played = replay(opened)
    assert any("arm stopped" in fault for fault in played.faults)
    lines = [item.value for one in opened for item in one.items() if isinstance(item.value, Line)]
    assert any(line.error and "arm stopped" in line.text for line in lines)
