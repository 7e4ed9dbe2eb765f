"""Replaying one part of a recording: frames are processed from the last reference on, in an earlier part."""

from __future__ import annotations

from pathlib import Path

import cv2
import pytest

from slipguard.config import sim_config
from slipguard.control.control_step import ControlState
from slipguard.daemon.store.recording import config_json
from slipguard.devices import Frame
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.recording import messages as m
from slipguard.recording.recorder import RecordedFrame, RecorderSettings, write_frame
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader
from slipguard.stress.grasps import rotated_grasp
from slipguard.tools.replay import recordings, replay

SPLIT = 8
GAP_S = 30.0


def record_parts(folder: Path, later_s: float = 0.0) -> list[Path]:
    """Write a grasp in two files: the reference is in the first one. later_s: time between the two."""
    grasp, config = rotated_grasp(2), sim_config("inline")
    assert grasp.background is not None
    background = {m.background_name("left"): cv2.imencode(".png", grasp.background)[1].tobytes()}
    facts = {"left.noise_bgr": str(list(grasp.noise_bgr or ()))}
    header = RecordingHeader(facts, {m.CONFIG_ATTACHMENT: config_json(config), **background})
    pipeline = Pipeline(Segmenter(), config.perception, grasp.background, grasp.noise_bgr, config.left.px_per_mm)
    parts = [range(SPLIT), range(SPLIT, len(grasp.frames))]
    written = []
    for number, part in enumerate(parts):
        path = folder / f"20261121T14301{number}.000Z.mcap"
        file = RecordingFile(path, RecordingClock(0, 0.0), header, ControlState(), grasp.times_s[part[0]])
        for k in part:
            at_s = grasp.times_s[k] + number * later_s
            estimate = pipeline.process(Frame(grasp.frames[k], at_s, k))
            record = m.FrameRecord(k, at_s, new_reference=not k, estimate=estimate)
            write_frame(file, RecordedFrame("left", at_s, record, grasp.frames[k]), RecorderSettings("png"))
        file.close()
        written.append(path)
    return written


@pytest.mark.parametrize("both", [True, False])
def test_a_later_part_goes_on_from_the_reference_of_an_earlier_one(both: bool, tmp_path: Path) -> None:
    parts = record_parts(tmp_path)
    played = replay(recordings(parts if both else parts[1:])).estimates
    assert played.frames == played.processed == (11 if both else 11 - SPLIT)
    assert played.differ == 0


def test_a_file_long_after_the_reference_is_not_processed(tmp_path: Path) -> None:
    parts = record_parts(tmp_path, GAP_S)
    assert replay(recordings(parts[1:])).estimates.processed == 0
    assert replay(recordings(parts)).estimates.processed == SPLIT
