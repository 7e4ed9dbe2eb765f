"""Networks side by side on rendered grasps that were not used to train them.

Each file runs as in the product: the whole 240x320 frame as input, one thread, the output enlarged to the frame and cut
at the network's own threshold. The frames are those of `slipguard bench`: rendered grasps of the ten test objects.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import dice, iou
from slipguard.datasets.rendered_grasps import render_grasp
from slipguard.errors import InputError
from slipguard.evaluation.lift_analysis import MASK_GAP_S, mask_of
from slipguard.evaluation.lift_recording import lift_paths, read_lift
from slipguard.perception.segmenter import Segmenter
from slipguard.sim.catalogue import object_names
from slipguard.tools.parallel import Workers, each
from slipguard.tools.replay import recorded_settings

EVERY = 6
"""Use every sixth frame of a grasp: neighboring frames hardly differ."""
FALSE_CONTACT_PX = 160
"""Of 76,800 pixels: a larger contact area on an untouched gel is a false contact."""
RESAMPLES = 2000
HEADER = "| network | Dice | IoU | lowest Dice | ms a frame, one thread | false contacts |\n|---|---|---|---|---|---|"


@dataclass(frozen=True, slots=True, eq=False)
class LabeledFrame:
    """A frame and its label. image, background (None: unknown): (320, 240, 3) uint8 BGR; mask: (320, 240) bool.

    source: object and grasp (or lift): frames of one grasp resemble each other.
    """

    image: NDArray[np.uint8]
    background: NDArray[np.uint8] | None
    mask: NDArray[np.bool_]
    source: tuple[str, str] = ("", "")


@dataclass(frozen=True, slots=True)
class NetworkComparison:
    """One network's scores over the frames with contact; times over all frames.

    Attributes:
        dice, iou: mean, and its 95 % interval by bootstrap over the grasps.
        lowest: object with the lowest mean Dice, and that mean.
        ms: mean and standard deviation of the one thread's processor time, which other load changes little.
        false_contacts: how many of the `untouched` frames.
    """

    name: str
    frames: int
    dice: tuple[float, float, float]
    iou: tuple[float, float, float]
    lowest: tuple[str, float]
    ms: tuple[float, float]
    false_contacts: int
    untouched: int

    def __str__(self) -> str:
        overlaps = [f"{mean:.3f} ({low:.3f}–{high:.3f})" for mean, low, high in (self.dice, self.iou)]
        lowest = f"{self.lowest[0]} {self.lowest[1]:.3f}"
        time_ms = f"{self.ms[0]:.2f} ± {self.ms[1]:.2f}"
        return (
            f"| {' | '.join([self.name, *overlaps, lowest, time_ms, f'{self.false_contacts} of {self.untouched}'])} |"
        )


def grasp_frames(seeds: Sequence[int], workers: Workers | None = None) -> list[LabeledFrame]:
    """Return frames of one grasp of each test object for each seed."""
    grasps = [(name, seed) for seed in seeds for name in object_names("test")]
    return [frame for frames in each(_labeled, grasps, workers) for frame in frames]


def recorded_frames(folder: Path) -> list[LabeledFrame]:
    """Return the frames of a simulated `slipguard evaluate run` for which the true contact was recorded."""
    found = []
    for path in lift_paths(folder):
        data = read_lift(path)
        settings = recorded_settings(data.recording)
        for finger, frames in data.fingers.items():
            images = {one.record.captured_at_s: one.image for one in frames if one.image is not None}
            times_s = np.array(list(images))
            for true in data.true_masks[finger] if images else ():
                near_s = float(times_s[np.argmin(np.abs(times_s - true.time_s))])
                if abs(near_s - true.time_s) <= MASK_GAP_S:
                    image, background = images[near_s].pixels(), settings.background(finger)
                    found.append(LabeledFrame(image, background, mask_of(true), (path.stem, finger)))
    if not found:
        raise InputError(f"{folder}: no recorded lift with true contact masks")
    return found


def compare_networks(
    networks: Sequence[tuple[str, Segmenter]], frames: Sequence[LabeledFrame]
) -> list[NetworkComparison]:
    """Run every (name, network) on every frame, frame by frame, so that all meet the same state of the machine."""
    scores = [_Scores() for _ in networks]
    for frame in frames:
        for (_, segmenter), score in zip(networks, scores, strict=True):
            score.add(segmenter, frame)
    return [score.summary(name) for (name, _), score in zip(networks, scores, strict=True)]


class _Scores:
    def __init__(self) -> None:
        self._overlaps: dict[tuple[str, str], list[tuple[float, float]]] = {}
        self._times_ms: list[float] = []
        self._false = self._untouched = 0

    def add(self, segmenter: Segmenter, frame: LabeledFrame) -> None:
        began_s = time.thread_time()
        probability = segmenter.segment(frame.image, frame.background)
        self._times_ms.append((time.thread_time() - began_s) * 1e3)
        mask = np.asarray(cv2.resize(probability, frame.mask.shape[::-1]) > segmenter.threshold)
        if frame.mask.any():
            self._overlaps.setdefault(frame.source, []).append((dice(mask, frame.mask), iou(mask, frame.mask)))
        else:
            self._untouched += 1
            self._false += int(mask.sum()) > FALSE_CONTACT_PX

    def summary(self, name: str) -> NetworkComparison:
        """Return the scores. Every grasp counts by its number of frames, in the resamples as well."""
        counts = np.array([len(one) for one in self._overlaps.values()])
        sums = np.array([np.sum(one, 0) for one in self._overlaps.values()])
        picks = np.random.default_rng(0).integers(0, len(sums), (RESAMPLES, len(sums)))
        means = sums[picks].sum(1) / counts[picks].sum(1)[:, None]
        low, high = np.quantile(means, (0.025, 0.975), axis=0)
        mean = sums.sum(0) / counts.sum()
        dices, ious = ((float(mean[k]), float(low[k]), float(high[k])) for k in (0, 1))
        objects: dict[str, list[float]] = {}
        for (shown, _), overlaps in self._overlaps.items():
            objects.setdefault(shown, []).extend(one[0] for one in overlaps)
        lowest = min(((shown, float(np.mean(one))) for shown, one in objects.items()), key=lambda one: one[1])
        ms = float(np.mean(self._times_ms)), float(np.std(self._times_ms))
        return NetworkComparison(name, int(counts.sum()), dices, ious, lowest, ms, self._false, self._untouched)


def _labeled(which: tuple[str, int]) -> list[LabeledFrame]:
    grasp = render_grasp(*which, with_masks=True, mask_every=EVERY)
    return [
        LabeledFrame(shot.frame.image, grasp.background, np.asarray(shot.mask > 0), (which[0], str(which[1])))
        for shot in grasp.shots[::EVERY]
        if shot.mask is not None
    ]
