"""Networks side by side on grasps that none of them saw: `python -m slipguard.training.paper.table MODEL.onnx...`.

Each file runs as the product runs it: the whole 240x320 frame in, one thread, its answer enlarged to the frame and cut
at its own threshold. The frames are those of `slipguard bench`: rendered grasps of the ten test objects.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import dice, iou
from slipguard.datasets.rendered_grasps import render_grasp
from slipguard.errors import SlipguardError
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.sim.catalogue import object_names
from slipguard.tools.parallel import Workers, each

EVERY = 6
"""Every so many frames of a grasp: neighbours hardly differ."""
FALSE_CONTACT_PX = 160
"""Of 76,800: more than that called contact on an untouched gel is a false contact."""


@dataclass(frozen=True, slots=True, eq=False)
class Known:
    """A frame and its label. image, background: (320, 240, 3) uint8 BGR; mask: (320, 240) bool."""

    image: NDArray[np.uint8]
    background: NDArray[np.uint8]
    mask: NDArray[np.bool_]


@dataclass(frozen=True, slots=True)
class Row:
    """One network's figures: mean and standard deviation over the frames with contact, ms over all of them.

    ms: processor time, which other work on the machine changes little; all of it is spent on one thread.
    false_contacts: of `untouched` frames.
    """

    name: str
    frames: int
    dice: tuple[float, float]
    iou: tuple[float, float]
    ms: tuple[float, float]
    false_contacts: int
    untouched: int

    def __str__(self) -> str:
        pairs = [f"{mean:.3f} ± {sd:.3f}" for mean, sd in (self.dice, self.iou)]
        cells = [
            self.name,
            *pairs,
            f"{self.ms[0]:.1f} ± {self.ms[1]:.1f}",
            f"{self.false_contacts} of {self.untouched}",
        ]
        return f"| {' | '.join(cells)} |"


def grasp_frames(seeds: Sequence[int], workers: Workers | None = None) -> list[Known]:
    """Frames of one grasp of each test object for each seed."""
    grasps = [(name, seed) for seed in seeds for name in object_names("test")]
    return [frame for frames in each(_grasp, grasps, workers) for frame in frames]


def rows(paths: Sequence[Path], frames: Sequence[Known]) -> list[Row]:
    """Run every file on every frame, one after the other on each, so that all meet the same state of the machine.

    Raises `ModelError` for a file that breaks the model contract.
    """
    segmenters = [Segmenter(path) for path in paths]
    tallies = [_Tally() for _ in paths]
    for frame in frames:
        for segmenter, tally in zip(segmenters, tallies, strict=True):
            tally.add(segmenter, frame)
    return [tally.row(path.stem) for path, tally in zip(paths, tallies, strict=True)]


class _Tally:
    def __init__(self) -> None:
        self._overlaps: list[tuple[float, float]] = []
        self._times_ms: list[float] = []
        self._false = self._untouched = 0

    def add(self, segmenter: Segmenter, frame: Known) -> None:
        began_s = time.thread_time()
        probability = segmenter.segment(frame.image, frame.background)
        self._times_ms.append((time.thread_time() - began_s) * 1e3)
        mask = np.asarray(cv2.resize(probability, frame.mask.shape[::-1]) > segmenter.threshold)
        if frame.mask.any():
            self._overlaps.append((dice(mask, frame.mask), iou(mask, frame.mask)))
        else:
            self._untouched += 1
            self._false += int(mask.sum()) > FALSE_CONTACT_PX

    def row(self, name: str) -> Row:
        mean, sd = np.mean(self._overlaps, 0), np.std(self._overlaps, 0)
        ms = float(np.mean(self._times_ms)), float(np.std(self._times_ms))
        dices, ious = ((float(mean[k]), float(sd[k])) for k in (0, 1))
        return Row(name, len(self._overlaps), dices, ious, ms, self._false, self._untouched)


def _grasp(which: tuple[str, int]) -> list[Known]:
    shown = render_grasp(*which, with_masks=True)
    return [
        Known(shot.frame.image, shown.background, np.asarray(shot.mask > 0))
        for shot in shown.shots[::EVERY]
        if shot.mask is not None
    ]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print a table in Markdown; the exit code is 0, or 1 for a file that cannot be used."""
    parser = argparse.ArgumentParser(prog="python -m slipguard.training.paper.table", description=__doc__)
    parser.add_argument("models", nargs="+", type=Path, help="ONNX files that keep the model contract")
    parser.add_argument("--grasps", type=int, default=2, help="grasps of each test object (default: 2)")
    asked = parser.parse_args(arguments)
    try:
        frames = grasp_frames(range(asked.grasps))
        table = rows(asked.models, frames)
    except SlipguardError as error:
        print(f"slipguard: {error}", file=sys.stderr)
        return 1
    print(f"{table[0].frames} frames with contact, {table[0].untouched} without; {asked.grasps} grasps of each object")
    print("| network | Dice | IoU | ms a frame, one thread | false contacts |\n|---|---|---|---|---|")
    for line in table:
        print(line)
    return 0


if __name__ == "__main__":
    sys.exit(main())
