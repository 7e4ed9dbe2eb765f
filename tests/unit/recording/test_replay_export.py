"""An export holds everything that is needed to understand it: also configuration and background images."""

from __future__ import annotations

import json
from pathlib import Path

from recorded_cycles import CLOCK, judged_at, tick_at

from slipguard.control.control_step import ControlState
from slipguard.recording import messages as m
from slipguard.recording.reader import open_recording
from slipguard.recording.writer import RecordingFile, RecordingHeader
from slipguard.tools.replay_export import export


def recorded(path: Path, force_n: float, backgrounds: dict[str, bytes]) -> Path:
    """Write a short recording with a configuration and background images."""
    config = json.dumps({"guard": {"first_force_n": force_n}}).encode()
    images = {m.background_name(finger): content for finger, content in backgrounds.items()}
    header = RecordingHeader({"slipguard": "0"}, {m.CONFIG_ATTACHMENT: config, **images})
    file = RecordingFile(path, CLOCK, header, ControlState(), 0.0)
    file.frame("left", 0.1, judged_at(0.1))
    file.cycle(tick_at(0.1))
    file.close()
    return path


def test_an_export_includes_configuration_and_background_images(tmp_path: Path) -> None:
    one = recorded(tmp_path / "a.mcap", 40.0, {"left": b"left image", "right": b"right image"})
    written = export([open_recording(one)], tmp_path / "out", {"png"})
    assert [path.name for path in written] == ["config.json", "background-left.png", "background-right.png"]
    assert json.loads((tmp_path / "out" / "config.json").read_text()) == {"guard": {"first_force_n": 40.0}}
    assert (tmp_path / "out" / "background-right.png").read_bytes() == b"right image"


def test_a_later_recording_adds_only_what_differs(tmp_path: Path) -> None:
    files = [
        recorded(tmp_path / "a.mcap", 40.0, {"left": b"left image"}),
        recorded(tmp_path / "b.mcap", 50.0, {"left": b"left image"}),
    ]
    written = export([open_recording(path) for path in files], tmp_path / "out", {"csv"})
    assert sorted(path.name for path in written) == [
        "b-config.json", "background-left.png", "config.json", "estimates.csv", "log.csv", "ticks.csv",
    ]  # fmt: skip


def test_the_name_of_an_attachment_cannot_leave_the_folder(tmp_path: Path) -> None:
    header = RecordingHeader({"slipguard": "0"}, {"../../escaped.json": b"{}"})
    RecordingFile(tmp_path / "a.mcap", CLOCK, header, ControlState(), 0.0).close()
    (path,) = export([open_recording(tmp_path / "a.mcap")], tmp_path / "deep" / "out", {"png"})
    assert path == tmp_path / "deep" / "out" / "escaped.json"
