"""Plot of the stored background images: the newest image of each gel, and its change since the first."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.perception.background import GelChange, compare_gel
from slipguard.tools.plotting import figure, save

GAIN = 8
"""Amplification of the change."""


def png_of(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


def draw(images: Mapping[str, bytes], stored: Mapping[str, Any], path: Path) -> None:
    """Draw the newest background image of each finger and its change, with marks circled.

    Args:
        images: PNG data by "FINGER NUMBER".
        stored: The response of `GET /background`.
        path: The image file to write.

    Raises:
        InputError: If the file cannot be written.
    """
    fingers = {name: entry for name, entry in stored.items() if entry["versions"]}
    drawing = figure(7.0, 4.6 * max(len(fingers), 1))
    grid = drawing.subplots(max(len(fingers), 1), 2, squeeze=False)
    for row in grid:
        for axes in row:
            axes.set_axis_off()
    for (now_axes, change_axes), (name, entry) in zip(grid, fingers.items(), strict=False):
        numbers = [number for number in (one["number"] for one in entry["versions"]) if f"{name} {number}" in images]
        first, newest = (_decoded(images[f"{name} {number}"]) for number in (numbers[0], numbers[-1]))
        facts = entry["versions"][-1]
        now_axes.imshow(newest[..., ::-1])
        now_axes.set_title(f"{name} {entry['serial']}: image {numbers[-1]}\n{facts['created_at'][:16]}", fontsize=9)
        change = compare_gel(newest.astype(np.float32), facts["frames"], first, facts["noise_bgr"], facts["frames"])
        difference = np.clip(128.0 + GAIN * (newest.astype(np.float32) - first), 0, 255).astype(np.uint8)
        change_axes.imshow(difference[..., ::-1])
        for mark in change.marks:
            change_axes.plot(mark.x_px, mark.y_px, "o", ms=14, mfc="none", mec="black")
        change_axes.set_title(_change(change, numbers[0]), fontsize=9)
    save(drawing, path)


def _decoded(png: bytes) -> NDArray[np.uint8]:
    return np.asarray(cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR), np.uint8)


def _change(change: GelChange, since: int) -> str:
    levels = " ".join(f"{level:+.1f}" for level in change.level_bgr)
    return f"change since image {since}, {GAIN}-fold\nB G R {levels}; marks: {len(change.marks)}"
