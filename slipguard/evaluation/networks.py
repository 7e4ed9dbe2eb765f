"""Several networks on the same recorded frames: masks against the true ones, and time, one core."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError, ModelError
from slipguard.evaluation.analyse import MASK_GAP_S, mask_of
from slipguard.evaluation.lift_data import FingerFrame, LiftData
from slipguard.evaluation.summary import lift_statistics
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.tools.replay import recorded_settings

EVERY = 10


class NetworkScore:
    """Gathers one network's figures over lifts."""

    def __init__(self, path: Path | None) -> None:
        self.name = "shipped" if path is None else path.stem
        self._segmenter = Segmenter(path)
        self._dice: list[float] = []
        self._iou: list[float] = []
        self._ms: list[float] = []

    def take(self, data: LiftData) -> None:
        """Segment the frames of a lift that have a true mask; where there are none, time every tenth frame."""
        settings = recorded_settings(data.recording)
        for finger, frames in data.fingers.items():
            pictured = [one for one in frames if one.picture is not None]
            if not pictured:
                continue
            background = settings.background(finger)
            masks = data.true_masks[finger]
            if not masks:
                for one in pictured[::EVERY]:
                    self._segment(one, background)
                continue
            times = np.array([one.judged.captured_at_s for one in pictured])
            for true in masks:
                near = int(np.argmin(np.abs(times - true.time_s)))
                if abs(times[near] - true.time_s) <= MASK_GAP_S:
                    found = self._segment(pictured[near], background)
                    self._dice.append(dice(found, mask_of(true)))
                    self._iou.append(iou(found, mask_of(true)))

    def _segment(self, one: FingerFrame, background: NDArray[np.uint8] | None) -> NDArray[np.bool_]:
        """The mask at frame size; the time it took is noted."""
        assert one.picture is not None
        image = one.picture.pixels()
        began_s = time.perf_counter()
        probability = self._segmenter.segment(image, background)
        self._ms.append(1e3 * (time.perf_counter() - began_s))
        return np.asarray(cv2.resize(probability, (image.shape[1], image.shape[0])) > self._segmenter.threshold)

    def as_json(self) -> dict[str, Any]:
        """n, Dice, IoU, median time."""
        return {
            "network": self.name,
            "n": len(self._ms),
            "dice": lift_statistics(self._dice).as_json(),
            "iou": lift_statistics(self._iou).as_json(),
            "ms_median": round(float(np.median(self._ms)), 2) if self._ms else None,
        }


def network_scores(folder: Path) -> list[NetworkScore]:
    """The shipped network and every usable one of a folder. Raises InputError where there is none."""
    files = sorted(folder.glob("*.onnx")) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: no .onnx networks in this folder")
    rows = [NetworkScore(None)]
    refused = []
    for file in files:
        try:
            rows.append(NetworkScore(file))
        except ModelError as error:
            refused.append(str(error))
    if len(rows) == 1:
        raise InputError(f"{folder}: no usable network: {refused[0]}")
    return rows
