"""Recordings leave free the disk space that the guard needs, and lose no kept file when it runs out."""

from __future__ import annotations

import errno
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np
import pytest
from recorded_cycles import CLOCK, HEADER, FullDisk, gel_image, judged_at, tick_at, written

from slipguard.control.control_step import ControlState
from slipguard.recording import messages as m
from slipguard.recording.reader import open_recording
from slipguard.recording.recorder import RecordedCycle, RecordedFrame, RecordedMessage, Recorder, RecorderSettings
from slipguard.recording.ring import Ring, RingLimits
from slipguard.recording.writer import RecordingClock, open_new

MB = 2**20
LIMITS = RingLimits(100, 10**9, 10**9)
GEL_IMAGES = [gel_image(seed) for seed in range(8)]


@dataclass
class Disk:
    """A disk of 20 MB, of which a folder and others use a part; 1 MB of it stays free."""

    folder: Path
    others: int = 0
    free_least: int = 20 * MB

    def usage(self, path: Path) -> tuple[int, int, int]:
        assert path.is_dir()
        used = self.others + sum(file.stat().st_size for file in self.folder.rglob("*.mcap"))
        self.free_least = min(self.free_least, 20 * MB - used)
        return 20 * MB, used, 20 * MB - used


class Counted(Recorder):
    """Reports each value it is done with."""

    taken: threading.Semaphore

    def _take(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        super()._take(value)
        self.taken.release()


@dataclass
class Playing:
    """A recorder that is handed cycles one by one, with an image each, and has written each before the next."""

    recorder: Counted
    reported: list[str]

    def play(self, from_s: float, to_s: float, keep_at: float | None = None) -> None:
        for now_s in np.arange(from_s, to_s, 0.1).tolist():
            self.recorder.add(RecordedFrame("left", now_s, judged_at(now_s), GEL_IMAGES[round(10 * now_s) % 8]))
            keep = keep_at is not None and bool(np.isclose(now_s, keep_at))
            self.recorder.add(RecordedCycle(tick_at(now_s), ControlState(), keep=keep))
            for _ in range(2):
                assert self.recorder.taken.acquire(timeout=20.0)


@pytest.fixture
def playing(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Playing]:
    monkeypatch.setattr("slipguard.recording.recorder.WAIT_S", 0.001)
    monkeypatch.setattr("slipguard.recording.recorder.RETRY_S", 0.0)

    def start(
        ring: Ring, opener: Callable[[Path], object] = open_new, clock: RecordingClock = CLOCK, **settings: float
    ) -> Playing:
        reported: list[str] = []
        asked = RecorderSettings("jpeg", **settings)  # type: ignore[arg-type]
        one = Counted(ring, asked, lambda: clock, lambda: HEADER, reported.append, opener)  # type: ignore[arg-type]
        one.taken = threading.Semaphore(0)
        one.start()
        return Playing(one, reported)

    return start


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def ticks(path: Path) -> list[float]:
    return [item.value.now_s for item in open_recording(path).items() if isinstance(item.value, m.CycleRecord)]


def whole(path: Path) -> bool:
    recording = open_recording(path)
    list(recording.items())
    return recording.damage is None


def test_the_ring_frees_the_reserve_of_the_disk(tmp_path: Path, playing: Callable[..., Playing]) -> None:
    disk = Disk(tmp_path, others=15 * MB)
    one = playing(Ring(tmp_path, LIMITS, disk.usage))
    one.play(0.0, 12.0)  # some 7 MB
    one.recorder.stop()
    assert one.reported == []
    assert disk.free_least > 0.8 * MB
    held = sorted((tmp_path / "ring").iterdir())
    assert 3 <= len(held) <= 5, "the newest stay"
    assert max(path.stat().st_size for path in held) < 1.2 * MB, "no file is larger than what stays free"
    assert ticks(held[-1])[-1] == pytest.approx(11.9)


def test_a_disk_filled_by_others_stops_the_recording_once_and_the_file_is_complete(
    tmp_path: Path, playing: Callable[..., Playing]
) -> None:
    disk = Disk(tmp_path)
    one = playing(Ring(tmp_path, LIMITS, disk.usage), segment_s=0.5)
    one.play(0.0, 2.8)
    assert len(names(tmp_path / "ring")) == 6
    disk.others = 20 * MB - 100_000
    one.play(2.8, 2.9)
    assert len(one.reported) == 1
    assert "MB of the disk are free (limit 1 MB)" in one.reported[0]
    one.play(2.9, 4.0)
    assert names(tmp_path / "ring") == [], "all of it, for the disk is still too full"
    disk.others = 18 * MB + 100_000
    one.play(4.0, 5.0)
    assert len(one.reported) == 1, "room for a moment is none to begin with"
    disk.others = 10 * MB
    one.play(5.0, 5.2)
    one.recorder.stop()
    assert one.reported[1:] == ["recording again"]
    assert one.recorder.stops == 1
    (path,) = (tmp_path / "ring").iterdir()
    assert whole(path)


def test_a_stop_without_space_completes_and_keeps_the_file(tmp_path: Path, playing: Callable[..., Playing]) -> None:
    disk = Disk(tmp_path)
    one = playing(Ring(tmp_path, LIMITS, disk.usage), segment_s=1.0)
    one.play(0.0, 1.5, keep_at=1.3)
    disk.others = 30 * MB
    one.play(1.5, 2.0)
    assert one.recorder.stopped is not None
    kept = sorted((tmp_path / "kept").iterdir())
    assert [now_s for path in kept for now_s in ticks(path)] == pytest.approx(np.arange(0.0, 1.5, 0.1))
    assert all(whole(path) for path in kept)
    one.recorder.stop()


def test_on_a_full_disk_the_ring_is_freed_first(tmp_path: Path, playing: Callable[..., Playing]) -> None:
    """Free by its own account, as under a quota."""
    room = iter((400_000, 10**9))
    (tmp_path / "ring").mkdir(exist_ok=True)
    for number in range(3):
        written(tmp_path / "ring" / f"{number}.mcap", 1).close()
        os.utime(tmp_path / "ring" / f"{number}.mcap", (number, number))
    one = playing(Ring(tmp_path, LIMITS), opener=lambda path: FullDisk(path, next(room)))
    one.play(0.0, 2.0)
    one.recorder.stop()
    assert one.reported == []
    left = names(tmp_path / "ring")
    assert len(left) == 4
    assert left[:2] == ["1.mcap", "2.mcap"], "the oldest made room"


@pytest.mark.parametrize("error", [errno.ENOSPC, errno.EIO])
def test_a_recording_that_cannot_begin_leaves_no_file(
    tmp_path: Path, playing: Callable[..., Playing], error: int
) -> None:
    ring = Ring(tmp_path, RingLimits(5, 10**9, 10**9))
    works = False

    def opener(path: Path) -> BinaryIO:
        return open_new(path) if works else Broken(path, error)  # type: ignore[return-value]

    good = [f"{number}.mcap" for number in range(3)] if error == errno.EIO else []
    (tmp_path / "ring").mkdir(exist_ok=True)
    for name in good:
        written(tmp_path / "ring" / name, 1).close()
    one = playing(ring, opener=opener)
    one.play(0.0, 3.0)
    assert names(tmp_path / "ring") == good
    assert len(one.reported) == 1
    works = True
    one.play(3.0, 3.2)
    one.recorder.stop()
    assert names(tmp_path / "ring")[: len(good)] == good
    assert len(names(tmp_path / "ring")) == len(good) + 1


class Broken(FullDisk):
    """A file that takes no more, for a reason of its own."""

    def __init__(self, path: Path, error: int, room: int = 0) -> None:
        super().__init__(path, room)
        self.error = error

    def write(self, data: bytes) -> int:
        if len(data) > self.room:
            raise OSError(self.error, os.strerror(self.error))
        return super().write(data)


def test_a_slip_before_the_disk_is_full_is_kept_with_the_time_before_it(
    tmp_path: Path, playing: Callable[..., Playing]
) -> None:
    room = iter((10**9, 10**9, 500_000, *[0] * 1000))
    one = playing(Ring(tmp_path, LIMITS), opener=lambda path: FullDisk(path, next(room)), segment_s=1.0)
    one.play(0.0, 3.0, keep_at=2.2)
    assert one.recorder.stopped is not None
    kept = sorted((tmp_path / "kept").iterdir())
    assert names(tmp_path / "ring") == []
    times = [now_s for path in kept for now_s in ticks(path)]
    assert min(times) == 0.0
    assert max(times) > 2.2
    one.recorder.stop()


def test_a_slip_while_nothing_is_recorded_keeps_earlier_and_later_files(
    tmp_path: Path, playing: Callable[..., Playing]
) -> None:
    room = iter((10**9, 500_000, *[0] * 6, *[10**9] * 9))
    one = playing(Ring(tmp_path, LIMITS), opener=lambda path: Broken(path, errno.EIO, next(room)), segment_s=1.0)
    one.play(0.0, 3.0, keep_at=2.0)
    assert one.reported
    one.recorder.stop()
    assert one.reported[-1] == "recording again"
    assert names(tmp_path / "ring") == []
    times = [now_s for path in sorted((tmp_path / "kept").iterdir()) for now_s in ticks(path)]
    assert min(times) == 0.0
    assert max(times) == pytest.approx(2.9)


def test_a_failed_move_is_tried_again(
    tmp_path: Path, playing: Callable[..., Playing], monkeypatch: pytest.MonkeyPatch
) -> None:
    trouble = iter((True, True))
    keep = Ring.keep

    def fails_at_first(self: Ring, path: Path) -> Path:
        if next(trouble, False):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return keep(self, path)

    monkeypatch.setattr(Ring, "keep", fails_at_first)
    one = playing(Ring(tmp_path, LIMITS), segment_s=1.0)
    one.play(0.0, 4.5, keep_at=3.4)
    one.recorder.stop()
    assert names(tmp_path / "ring") == []
    begins = [ticks(path)[0] for path in sorted((tmp_path / "kept").iterdir())]
    assert begins == pytest.approx([0.0, 1.0, 2.0, 3.0, 3.4, 4.4], abs=0.01)


def test_the_ring_stays_within_its_megabytes(tmp_path: Path, playing: Callable[..., Playing]) -> None:
    one = playing(Ring(tmp_path, RingLimits(4, 8 * MB, 10**9)))
    most = 0
    for second in range(20):  # some 12 MB
        one.play(second, second + 1.0)
        most = max(most, sum(path.stat().st_size for path in (tmp_path / "ring").iterdir()))
    one.recorder.stop()
    assert 5 * MB < most <= 8 * MB
    assert all(path.stat().st_size < 2.25 * MB for path in (tmp_path / "ring").iterdir())


@pytest.mark.parametrize("other_s", [-50.0, 86_400.0], ids=["too long ago", "written while the clock was wrong"])
def test_a_slip_soon_after_a_restart_keeps_files_from_before_it(
    tmp_path: Path, playing: Callable[..., Playing], other_s: float
) -> None:
    ring = Ring(tmp_path, LIMITS)
    now = time.time()
    (tmp_path / "ring").mkdir()
    for name, ended_s in (("a", now + other_s), ("b", now - 15.0), ("c", now - 5.0)):
        written(tmp_path / "ring" / f"{name}.mcap", 1).close()
        os.utime(tmp_path / "ring" / f"{name}.mcap", (ended_s, ended_s))
    one = playing(ring, clock=RecordingClock(time.time_ns(), 1000.0))
    one.play(1000.0, 1000.5, keep_at=1000.0)
    one.recorder.stop()
    assert names(tmp_path / "kept")[1:] == ["b.mcap", "c.mcap"]
    assert names(tmp_path / "ring") == ["a.mcap"]
