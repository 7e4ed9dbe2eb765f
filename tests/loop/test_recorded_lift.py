"""A lift recorded on the virtual clock: replaying the controller on it gives the same commands."""

from __future__ import annotations

import asyncio
import errno
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

import pytest
from loop_cell import Cell, play

from slipguard.config import RecordingSection
from slipguard.daemon.store import recording
from slipguard.recording import messages as m
from slipguard.recording.reader import open_recording
from slipguard.recording.recorder import Recorder
from slipguard.recording.writer import open_new
from slipguard.tools.replay import recordings, replay

ROOM_BYTES = 100_000


def recorded(
    cell: Cell, folder: Path, *, fail: str | None = None, opener: Callable[[Path], BinaryIO] = open_new
) -> Recorder:
    without_pictures = RecordingSection(image="none")
    cell.service.config = cell.service.config.model_copy(update={"recording": without_pictures})
    made: list[Recorder] = []

    async def scene(cell: Cell) -> None:
        recorder = recording.make_recorder(cell.service, folder)
        recorder._opener = opener
        made.append(recorder)
        observers = [list(finger.observers) for finger in cell.service.fingers.values()]
        task = asyncio.create_task(recording.record(cell.service, recorder))
        await cell.grasp()
        if fail is not None:
            cell.world.faults.fail("arm", fail)
            await asyncio.sleep(0.5)
        else:
            await cell.lift()
            await asyncio.sleep(0.5)
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
        assert recorder.left_out == 0
        after = [list(finger.observers) for finger in cell.service.fingers.values()]
        assert after == observers, "the recorder still observes"

    play(cell, scene)
    return made[0]


@pytest.fixture(scope="module")
def lift(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Recordings of a lift with a slip; not to be changed."""
    folder = tmp_path_factory.mktemp("lift")
    cell = Cell("wrench", 1)
    recorder = recorded(cell, folder)
    assert recorder.stopped is None
    assert any("tightening" in line for line in cell.messages)
    return folder / "kept"


def longest(folder: Path) -> Path:
    """A new no-contact image at the start makes a file of its own."""
    return max(folder.iterdir(), key=lambda path: path.stat().st_size)


def ticks(path: Path) -> list[m.CycleRecord]:
    return [item.value for item in open_recording(path).items() if isinstance(item.value, m.CycleRecord)]


def test_a_lift_with_slip_is_kept_and_replays_to_the_same_commands(lift: Path) -> None:
    played = replay(recordings([lift]))
    assert played.on_recorded.ticks > 200
    assert played.on_recorded.differences == []
    assert played.damage == []
    assert [phase for _, phase in played.phases] == ["idle", "closing", "reference", "holding", "lifting", "holding"]


def test_a_controller_that_decides_otherwise_is_detected(lift: Path) -> None:
    opened = recordings([lift])
    for one in opened:
        config = json.loads(one.attachments[m.CONFIG_ATTACHMENT])
        config["guard"] |= {"friction": 0.5, "mass_kg": 0.6, "lever_mm": 60.0}
        one.attachments[m.CONFIG_ATTACHMENT] = json.dumps(config).encode()
    played = replay(opened)
    assert played.on_recorded.differences
    first = played.on_recorded.differences[0]
    assert first.recorded.hold_force_n is not None
    assert first.replayed.hold_force_n != first.recorded.hold_force_n


class FillingUp:
    """A file on a disk with room for a limited number of bytes."""

    def __init__(self, path: Path) -> None:
        self._file, self._room = open_new(path), ROOM_BYTES

    def write(self, data: bytes) -> int:
        if len(data) > self._room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self._room -= len(data)
        return self._file.write(data)

    def flush(self) -> None: ...

    def close(self) -> None:
        self._file.close()


def test_a_disk_that_fills_up_ends_the_recording_and_not_the_guard(tmp_path: Path) -> None:
    cell = Cell("wrench", 1)
    recorder = recorded(cell, tmp_path, opener=FillingUp)  # type: ignore[arg-type]
    assert recorder.stopped is not None
    assert "No space left on device" in recorder.stopped
    reported = [line for line in cell.service.event_log.lines if "recording stopped" in line]
    assert len(reported) == 1
    assert "the guard goes on" in reported[0]
    assert any("tightening" in line for line in cell.messages), "the object slipped and the grip was not tightened"
    assert ticks(longest(tmp_path / "kept")), "the slip came after, what was before it is kept"
