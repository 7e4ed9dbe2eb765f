"""How well, and how quickly, an exported network outlines contact on frames whose masks are known."""

from __future__ import annotations

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipguard.datasets.mask_scores import dice, iou
from slipguard.training.onnx_file import session
from slipguard.training.paper.frames import MaskedFrames


@dataclass(frozen=True, slots=True)
class Score:
    """Mean and standard deviation over `frames` frames; ms: processor time of the network alone, one thread."""

    frames: int
    dice: float
    dice_sd: float
    iou: float
    iou_sd: float
    ms: float
    ms_sd: float

    def __str__(self) -> str:
        return (
            f"Dice {self.dice:.3f} ± {self.dice_sd:.3f}, IoU {self.iou:.3f} ± {self.iou_sd:.3f}, "
            f"{self.ms:.1f} ± {self.ms_sd:.1f} ms of one thread a frame (n = {self.frames})"
        )


def score(path: Path, frames: MaskedFrames, threshold: float) -> Score:
    """Run the file on every frame, which must be of the network's size; the first frame is run once more for warmth."""
    running = session(path)
    running.run(None, {"frame": np.array(frames.frame[:1])})
    rows = []
    for index in range(len(frames)):
        feed = {"frame": np.array(frames.frame[index : index + 1])}
        began_s = time.thread_time()
        answer = running.run(None, feed)[0]
        took_ms = (time.thread_time() - began_s) * 1e3
        mask, truth = answer[0, 0] > threshold, np.asarray(frames.mask[index] > 127)
        rows.append((dice(mask, truth), iou(mask, truth), took_ms))
    mean, sd = np.mean(rows, 0), np.std(rows, 0)
    values = [float(value) for pair in zip(mean, sd, strict=True) for value in pair]
    return Score(len(frames), *values)
