"""Several networks on the same recorded frames: masks against the true ones, and time, one core."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from slipguard.errors import InputError, ModelError
from slipguard.lab.evaluate.analyse import MASK_GAP_S, mask_of
from slipguard.lab.evaluate.lift_data import LiftData
from slipguard.lab.evaluate.summary import spread
from slipguard.lab.replay import settings_of
from slipguard.lab.scores import dice, iou
from slipguard.perception.segment import Segmenter


class NetworkRow:
    """Gathers one network's figures over lifts."""

    def __init__(self, path: Path | None) -> None:
        self.name = "shipped" if path is None else path.stem
        self._segmenter = Segmenter(path)
        self._dice: list[float] = []
        self._iou: list[float] = []
        self._ms: list[float] = []

    def take(self, data: LiftData) -> None:
        """Segment the frames of a lift that have a true mask."""
        settings = settings_of(data.recording)
        for finger, frames in data.fingers.items():
            pictured = [one for one in frames if one.picture is not None]
            times = np.array([one.judged.captured_at_s for one in pictured])
            background = settings.background(finger)
            for true in data.true_masks[finger] if len(times) else []:
                near = int(np.argmin(np.abs(times - true.time_s)))
                picture = pictured[near].picture
                if picture is None or abs(times[near] - true.time_s) > MASK_GAP_S:
                    continue
                image = picture.pixels()
                began_s = time.perf_counter()
                probability = self._segmenter.segment(image, background)
                self._ms.append(1e3 * (time.perf_counter() - began_s))
                found = cv2.resize(probability, (image.shape[1], image.shape[0])) > self._segmenter.threshold
                self._dice.append(dice(np.asarray(found), mask_of(true)))
                self._iou.append(iou(np.asarray(found), mask_of(true)))

    def as_json(self) -> dict[str, Any]:
        """n, Dice, IoU, median time."""
        return {
            "network": self.name,
            "n": len(self._dice),
            "dice": spread(self._dice).as_json(),
            "iou": spread(self._iou).as_json(),
            "ms_median": round(float(np.median(self._ms)), 2) if self._ms else None,
        }


def network_rows(folder: Path) -> list[NetworkRow]:
    """The shipped network and every usable one of a folder. Raises InputError where there is none."""
    files = sorted(folder.glob("*.onnx")) if folder.is_dir() else []
    if not files:
        raise InputError(f"{folder}: no .onnx networks in this folder")
    rows = [NetworkRow(None)]
    refused = []
    for file in files:
        try:
            rows.append(NetworkRow(file))
        except ModelError as error:
            refused.append(str(error))
    if len(rows) == 1:
        raise InputError(f"{folder}: no usable network: {refused[0]}")
    return rows
