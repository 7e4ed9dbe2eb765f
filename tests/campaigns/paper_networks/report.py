"""Report of a training: curves over the epochs, and accuracy and speed of the exported network."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipguard.datasets.mask_scores import dice, iou
from slipguard.tools.plotting import figure, save
from slipguard.training.onnx_export import open_session
from tests.campaigns.paper_networks.frames import MaskedFrames
from tests.campaigns.paper_networks.training import PaperEpoch


@dataclass(frozen=True, slots=True)
class NetworkScore:
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
            f"{self.ms:.1f} ± {self.ms_sd:.1f} ms per frame on one thread (n = {self.frames})"
        )


def score_network(path: Path, frames: MaskedFrames, threshold: float) -> NetworkScore:
    """Run a network file on frames with known masks, of the network's size; the first frame also warms it up."""
    session = open_session(path)
    session.run(None, {"frame": np.array(frames.frame[:1])})
    rows = []
    for index in range(len(frames)):
        feed = {"frame": np.array(frames.frame[index : index + 1])}
        start_s = time.thread_time()
        output = session.run(None, feed)[0]
        took_ms = (time.thread_time() - start_s) * 1e3
        mask, truth = output[0, 0] > threshold, np.asarray(frames.mask[index] > 127)
        rows.append((dice(mask, truth), iou(mask, truth), took_ms))
    mean, sd = np.mean(rows, 0), np.std(rows, 0)
    values = [float(value) for pair in zip(mean, sd, strict=True) for value in pair]
    return NetworkScore(len(frames), *values)


def draw_curves(history: Sequence[PaperEpoch], title: str, path: Path) -> None:
    """Draw loss, Dice and IoU over the epochs into an image file.

    Raises:
        InputError: The file cannot be written.
    """
    drawing = figure(8.0, 3.4)
    left, right = drawing.subplots(1, 2)
    numbers = [epoch.number for epoch in history]
    left.plot(numbers, [epoch.loss for epoch in history], "o-", color="tab:red", label="training")
    left.set(xlabel="epoch", ylabel="focal loss", title=title)
    left.set_ylim(bottom=0.0)
    for name, color in (("dice", "tab:blue"), ("iou", "tab:orange")):
        values = [getattr(epoch, name) for epoch in history]
        label = f"{'Dice' if name == 'dice' else 'IoU'}, {values[-1]:.3f} at the end"
        right.plot(numbers, values, "o-", color=color, label=label)
    right.set(xlabel="epoch", ylabel="mean over held-out frames", ylim=(0.0, 1.0))
    for axes in (left, right):
        axes.set_xticks(numbers if len(numbers) <= 12 else numbers[:: len(numbers) // 10])
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right" if axes is right else "upper right")
    save(drawing, path)
