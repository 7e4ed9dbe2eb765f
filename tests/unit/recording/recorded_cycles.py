"""Cycles and frames to record, and a disk that fills up."""

from __future__ import annotations

import errno
import math
import os
from pathlib import Path
from typing import BinaryIO

import cv2
import numpy as np

from slipguard.control.control_step import ControlState
from slipguard.control.messages import HoldForce, Observation, StepOutput
from slipguard.perception.estimate import Estimate
from slipguard.recording import messages as m
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader, open_new

CLOCK = RecordingClock(1_700_000_000_000_000_000, 0.0)
HEADER = RecordingHeader({"slipguard": "0"}, {m.CONFIG_ATTACHMENT: b"{}"})


def tick_at(now_s: float) -> m.CycleRecord:
    return m.CycleRecord(now_s, "holding", Observation(now_s=now_s), StepOutput(HoldForce(now_s)), 1, None)


def judged_at(now_s: float) -> m.FrameRecord:
    return m.FrameRecord(
        7, now_s, estimate=Estimate(7, now_s, now_s, True, 4000, "fused", rotation_deg=math.pi, sigma_deg=0.1)
    )


def gel_image(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 255, (320, 240, 3), np.uint8)


def written(path: Path, count: int = 200) -> RecordingFile:
    file = RecordingFile(path, CLOCK, HEADER, ControlState(), 0.0)
    for number in range(count):
        at_s = number / 60
        file.image("left", at_s, cv2.imencode(".jpg", gel_image(number))[1].tobytes(), "jpeg")
        file.frame("left", at_s, judged_at(at_s))
        file.cycle(tick_at(at_s))
        file.log(at_s, "info", f"line {number}")
    return file


class FullDisk:
    """A file on a disk that fills up."""

    def __init__(self, path: Path, room: int) -> None:
        self.file: BinaryIO = open_new(path)
        self.room = room

    def write(self, data: bytes) -> int:
        if len(data) > self.room:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.room -= len(data)
        return self.file.write(data)

    def flush(self) -> None:
        self.file.flush()

    def close(self) -> None:
        self.file.close()
