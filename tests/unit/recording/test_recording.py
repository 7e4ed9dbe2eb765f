"""Recordings are exact, readable up to where they were cut, and within their limits; they never delay the guard."""

from __future__ import annotations

import math
import os
import shutil
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from recorded_cycles import CLOCK, HEADER, FullDisk, gel_image, judged_at, tick_at, written

from slipguard.control.contact_motion import ContactMotion
from slipguard.control.control_step import ControlState
from slipguard.control.load_state import LoadState
from slipguard.control.messages import HaltJaws, HoldForce, LiftArm, MoveJaws, Observation, ReleaseJaws, StepOutput
from slipguard.control.reports import Text
from slipguard.control.state import GraspState, Grip, HeldObject, Phase
from slipguard.daemon.loop.finger import ProcessedFrame
from slipguard.daemon.store.recording import RecordingObserver
from slipguard.devices import Frame
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate
from slipguard.perception.patch import find_patch
from slipguard.recording import messages as m
from slipguard.recording.reader import StoredImage, StoredMessage, open_recording
from slipguard.recording.recorder import RecordedCycle, RecordedFrame, RecordedMessage, Recorder, RecorderSettings
from slipguard.recording.ring import Ring, RingLimits
from slipguard.recording.writer import RecordingHeader

LIMITS = RingLimits(100, 10**9, 10**9)


def recorder(folder: Path, **settings: object) -> Recorder:
    return Recorder(
        Ring(folder, LIMITS),
        RecorderSettings(**settings),  # type: ignore[arg-type]
        lambda: CLOCK,
        header=lambda: HEADER,
        on_trouble=lambda text: None,
    )


def play(one: Recorder, times: np.ndarray, keep_at: float | None = None) -> None:
    one.start()
    for now_s in times:
        one.add(RecordedFrame("left", float(now_s), judged_at(float(now_s)), gel_image(), gel_image()[..., 0] // 128))
        one.add(
            RecordedCycle(
                tick_at(float(now_s)), ControlState(), keep=keep_at is not None and bool(np.isclose(now_s, keep_at))
            )
        )
    one.stop(20.0)


def test_the_controllers_values_keep_every_bit() -> None:
    held = HeldObject(load=LoadState(ContactMotion((1 / 3, 0.0, 0.0)), far_frames=1))
    memory = ControlState(GraspState(Phase.LIFTING, 0.1 + 0.2, grip=Grip(commanded_s=-math.inf), held=held))
    assert m.MEMORY.decode(m.MEMORY.encode(memory)) == memory
    for gripper in (None, HoldForce(1 / 3), MoveJaws(1 / 3, 40.0), HaltJaws(), ReleaseJaws(1 / 3)):
        output = StepOutput(gripper, LiftArm(1 / 3, 2 / 3), messages=(Text.GRIPPED.message(),))
        cycle = m.CycleRecord(1e-17, "idle", Observation(now_s=1 / 7), output)
        assert m.CYCLE_RECORD.decode(m.CYCLE_RECORD.encode(cycle)) == cycle


def test_a_frame_measured_by_its_texture_is_recorded_without_a_mask() -> None:
    recorded: list[Any] = []
    observer = RecordingObserver(SimpleNamespace(records_images=False, add=recorded.append))  # type: ignore[arg-type]
    patch = find_patch(np.ones((160, 120), np.float32), 0.5, 100, 2.0)
    for segmented in (True, False):
        estimate = Estimate(1, 1.0, 1.0, True, 4000, "fused", segmented=segmented)
        observer.add_frame("left", ProcessedFrame(Frame(gel_image(), 1.0, 1), 1.0, False, False, estimate, None, patch))
    assert [one.mask is not None for one in recorded] == [True, False]
    assert b"segmented" not in m.FRAME_RECORD.encode(recorded[1].record)


def test_a_recording_is_read_as_written(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap").close()
    recording = open_recording(tmp_path / "a.mcap")
    items = list(recording.items())
    assert recording.damage is None
    assert recording.attachments == {m.CONFIG_ATTACHMENT: b"{}"}
    assert items[0].value == ControlState()
    ticks = [item.value for item in items if isinstance(item.value, m.CycleRecord)]
    assert ticks == [tick_at(number / 60) for number in range(200)]
    assert [item.value.text for item in items if isinstance(item.value, StoredMessage)][-1] == "line 199"
    shown = next(item for item in items if isinstance(item.value, StoredImage))
    assert shown.at_ns == CLOCK.wall_ns
    assert isinstance(shown.value, StoredImage)
    assert shown.value.pixels().shape == (320, 240, 3)


@pytest.mark.parametrize(
    ("umask", "modes"), [(0o000, [0o750, 0o640]), (0o022, [0o750, 0o640]), (0o077, [0o700, 0o600])]
)
def test_recordings_are_for_their_user_and_group_only(umask: int, modes: list[int], tmp_path: Path) -> None:
    own = os.umask(umask)
    try:
        ring = Ring(tmp_path / "recordings", RingLimits(3, 10**9, 10**9))
        path = ring.new(CLOCK.wall_ns)
        written(path, 1).close()
        kept = ring.keep(path)
    finally:
        os.umask(own)
    folders = (ring.ring.parent, ring.ring, ring.kept)
    assert [folder.stat().st_mode & 0o777 for folder in folders] == modes[:1] * 3
    assert kept.stat().st_mode & 0o777 == modes[1]


def test_an_independent_reader_finds_every_message_and_a_schema_for_each_topic(tmp_path: Path) -> None:
    written(tmp_path / "a.mcap").close()
    with (tmp_path / "a.mcap").open("rb") as file:
        seen = [(schema.name, channel.topic) for schema, channel, _ in make_reader(file).iter_messages()]
    assert len(seen) == 801
    assert ("foxglove.CompressedImage", "/left/image") in seen
    assert ("foxglove.Log", "/log") in seen
    assert ("slipguard.CycleRecord", "/tick") in seen


def test_a_file_cut_anywhere_is_readable_up_to_there(tmp_path: Path) -> None:
    written(tmp_path / "whole.mcap", 60).close()
    whole = (tmp_path / "whole.mcap").read_bytes()
    expected = [
        item for item in open_recording(tmp_path / "whole.mcap").items() if isinstance(item.value, m.CycleRecord)
    ]
    cut = tmp_path / "cut.mcap"
    for size in np.random.default_rng(1).integers(0, len(whole), 100):
        cut.write_bytes(whole[:size])
        try:
            recording = open_recording(cut)
        except InputError as error:
            assert size < 3000, error  # noqa: PT017 - only a file cut within its header cannot be opened
            continue
        ticks = [item for item in recording.items() if isinstance(item.value, m.CycleRecord)]
        assert recording.damage is not None
        assert ticks == expected[: len(ticks)]
        share = size / len(whole)
        assert len(ticks) >= (share - 0.05) * len(expected) - 2


def test_a_flipped_byte_ends_reading_without_a_crash(tmp_path: Path) -> None:
    written(tmp_path / "whole.mcap", 30).close()
    whole = (tmp_path / "whole.mcap").read_bytes()
    bad = tmp_path / "bad.mcap"
    rng = np.random.default_rng(2)
    for at in rng.integers(0, len(whole), 100):
        bad.write_bytes(whole[:at] + bytes([whole[at] ^ 0x5A]) + whole[at + 1 :])
        try:
            list(open_recording(bad).items())
        except InputError as error:
            assert "\n" not in str(error)  # noqa: PT017


@pytest.mark.parametrize("content", [b"", b"nothing of the kind", b"\x89MCAP0\r\n", os.urandom(500)])
def test_a_file_that_is_no_recording_is_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.mcap"):
        open_recording(tmp_path / "a.mcap")


def test_a_killed_recorder_loses_only_the_last_moment(tmp_path: Path) -> None:
    file = written(tmp_path / "a.mcap", 300)
    file.abandon()
    recording = open_recording(tmp_path / "a.mcap")
    last = [item.value for item in recording.items() if isinstance(item.value, m.CycleRecord)][-1]
    assert last.now_s > 299 / 60 - 1.0
    assert recording.damage == "is cut off (killed, or the disk was full)"


def test_files_around_an_event_are_kept_and_others_deleted(tmp_path: Path) -> None:
    limits = RingLimits(3, 10**9, 10**9)
    one = Recorder(
        Ring(tmp_path, limits),
        RecorderSettings("none", 90, segment_s=1.0, keep_before_s=1.5, keep_after_s=1.5),
        lambda: CLOCK,
        header=lambda: HEADER,
        on_trouble=lambda text: None,
    )
    play(one, np.arange(0.0, 20.0, 0.25), keep_at=10.25)
    kept = [list(open_recording(path).items()) for path in sorted((tmp_path / "kept").iterdir())]
    times = [item.value.now_s for items in kept for item in items if isinstance(item.value, m.CycleRecord)]
    assert min(times) <= 10.25 - 1.5
    assert max(times) >= 10.25 + 1.5
    assert min(times) >= 7.0
    assert max(times) <= 13.0
    assert len(list((tmp_path / "ring").iterdir())) == 3


def test_kept_files_are_limited(tmp_path: Path) -> None:
    ring = Ring(tmp_path, RingLimits(10, 10**9, 2500))
    for number in range(5):
        path = ring.new(CLOCK.wall_ns + number * 10**9)
        path.write_bytes(bytes(1000))
        os.utime(path, (number, number))
        ring.keep(path)
        assert len(list((tmp_path / "kept").iterdir())) <= 2, "room is made before"
    ring.tidy()
    kept = ["20231114T221323.000Z.mcap", "20231114T221324.000Z.mcap"]
    assert [path.name for path in sorted((tmp_path / "kept").iterdir())] == kept
    older = ring.new(CLOCK.wall_ns - 10**9)
    older.write_bytes(bytes(1000))
    os.utime(older, (0, 0))
    ring.keep(older)
    ring.tidy()
    assert [path.name for path in sorted((tmp_path / "kept").iterdir())] == kept, "none makes room for an older one"


def test_unfinished_files_of_a_killed_daemon_are_kept(tmp_path: Path) -> None:
    ring = Ring(tmp_path, LIMITS)
    written(ring.new(CLOCK.wall_ns), 100).abandon()
    written(ring.new(CLOCK.wall_ns + 10**9), 3).close()
    ring.keep_unfinished()
    assert len(list((tmp_path / "kept").iterdir())) == 1
    assert len(list((tmp_path / "ring").iterdir())) == 1


def test_files_dated_in_the_future_are_deleted_first(tmp_path: Path) -> None:
    """The clock of a computer that has just started may be years ahead; what is written later must not go for that."""
    ring = Ring(tmp_path, RingLimits(3, 10**9, 2500))
    ahead_s = time.time() + 5 * 365 * 86400.0
    for number in range(3):
        path = ring.new(round(1e9 * (ahead_s + number)))
        path.write_bytes(bytes(1000))
        os.utime(path, (ahead_s + number, ahead_s + number))
        (tmp_path / "kept").mkdir(exist_ok=True)
        shutil.copy2(path, tmp_path / "kept")
    new = []
    for number in range(4):
        new.append(ring.new(time.time_ns() + number * 10**6))
        new[-1].write_bytes(bytes(1000))
        ring.tidy(new[-1])
        assert all(path.exists() for path in new[-3:])
    assert sorted((tmp_path / "ring").iterdir()) == new[1:]
    kept = [ring.keep(path) for path in new[1:3]]
    ring.tidy()
    assert sorted((tmp_path / "kept").iterdir()) == kept


def test_any_other_failure_stops_the_recording_but_not_its_thread(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("slipguard.recording.recorder.RETRY_S", 0.0)
    reported: list[str] = []
    headers = iter((ValueError("a model\nthat is none"), ValueError("still none"), HEADER))

    def header() -> RecordingHeader:
        one = next(headers)
        if isinstance(one, Exception):
            raise one
        return one

    one = Recorder(Ring(tmp_path, LIMITS), RecorderSettings("none"), lambda: CLOCK, header, reported.append)
    assert not one.dead
    one.start()
    for number in range(4):
        one.add(RecordedCycle(tick_at(number / 10), ControlState()))
    one.stop(20.0)
    assert "recording stopped: ValueError: a model that is none" in reported[0]
    assert reported[1:] == ["recording again"]
    assert (one.stops, one.stopped, one.dead) == (1, None, True)  # it was ended
    assert len(list((tmp_path / "ring").iterdir())) == 1


def test_a_full_disk_stops_the_recording_with_one_message(tmp_path: Path) -> None:
    reported: list[str] = []
    one = Recorder(
        Ring(tmp_path, LIMITS),
        RecorderSettings("jpeg"),
        lambda: CLOCK,
        header=lambda: HEADER,
        on_trouble=reported.append,
        opener=lambda path: FullDisk(path, 300_000),  # type: ignore[arg-type,return-value]
    )
    play(one, np.arange(0.0, 3.0, 0.02))
    assert len(reported) == 1
    assert "No space left on device" in reported[0]
    assert one.stopped is not None
    (path,) = (tmp_path / "ring").iterdir()
    assert any(isinstance(item.value, m.CycleRecord) for item in open_recording(path).items())


def test_adding_values_never_waits_and_leaves_out_images_first(tmp_path: Path) -> None:
    one = recorder(tmp_path)
    for number in range(2500):  # not started: no thread takes anything
        one.add(RecordedFrame("left", number / 60, judged_at(number / 60), gel_image() if number < 600 else None))
    assert one.left_out == 600 - 500 + 2500 - 2000
    one.start()
    one.add(RecordedMessage(1.0, "a line"))
    one.stop(20.0)


def test_png_keeps_every_pixel(tmp_path: Path) -> None:
    one = recorder(tmp_path, image="png")
    one.start()
    one.add(RecordedCycle(tick_at(0.0), ControlState()))
    one.add(RecordedFrame("right", 0.0, judged_at(0.0), gel_image(5)))
    one.stop(20.0)
    (path,) = (tmp_path / "ring").iterdir()
    pixels = [item.value.pixels() for item in open_recording(path).items() if isinstance(item.value, StoredImage)]
    assert np.array_equal(pixels[0], gel_image(5))
