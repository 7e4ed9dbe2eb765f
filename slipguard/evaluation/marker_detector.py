"""The two markers' corners in a picture."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.evaluation.markers import GRIPPER_ID, OBJECT_ID, dictionary

SIDE_MIN_PX = 12.0
"""Smaller markers are found by chance, and their turn not to a degree."""
FIND_BLUR_PX = 0.8
"""Noise makes hundreds of false candidates; corners are found on the picture itself."""
CELLS = 6
REACH_MAX_PX = 6.0
STEP_PX = 0.25
RISE_MIN = 25.0
"""Grey levels from black to white below which there is no edge."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerCorners:
    """Corners (4, 2) in pixels, clockwise from the marker's upper left; None where the marker was not seen."""

    time_s: float
    gripper_px: NDArray[np.float32] | None
    object_px: NDArray[np.float32] | None


class MarkerDetector:
    """Finds both markers, where they were last if they are still there; not thread-safe."""

    def __init__(self) -> None:
        self._detector = cv2.aruco.ArucoDetector(dictionary(), cv2.aruco.DetectorParameters())
        self._last: list[NDArray[np.float32]] = []

    def look(self, image: NDArray[np.uint8], time_s: float) -> MarkerCorners:
        """image: (h, w, 3) or (h, w) uint8. A marker seen twice is not seen: nobody can tell which it is."""
        grey = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        found = self._find(grey, _around(self._last, grey.shape)) if self._last else {}
        if len(found) < 2:
            found = self._find(grey, (0, 0, grey.shape[1], grey.shape[0]))
        self._last = list(found.values()) if len(found) == 2 else []
        refined = {marker_id: refined_corners(grey, corners) for marker_id, corners in found.items()}
        return MarkerCorners(time_s, refined.get(GRIPPER_ID), refined.get(OBJECT_ID))

    def _find(self, grey: NDArray[np.uint8], window: tuple[int, int, int, int]) -> dict[int, NDArray[np.float32]]:
        left, top, right, bottom = window
        part = cv2.GaussianBlur(grey[top:bottom, left:right], (0, 0), FIND_BLUR_PX)
        corners, ids, _ = self._detector.detectMarkers(part)
        found: dict[int, list[NDArray[np.float32]]] = {GRIPPER_ID: [], OBJECT_ID: []}
        for marker_id, corner in zip([] if ids is None else ids.ravel(), corners, strict=True):
            if int(marker_id) in found:
                here = np.asarray(corner, np.float32).reshape(4, 2) + np.array([left, top], np.float32)
                found[int(marker_id)].append(here)
        return {
            marker_id: one[0] for marker_id, one in found.items() if len(one) == 1 and _side_px(one[0]) >= SIDE_MIN_PX
        }


def refined_corners(grey: NDArray[np.uint8], corners: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Corners (4, 2) as the meeting points of straight lines through the edges of the black square.

    Every edge pixel takes part, so noise averages out; the marker's inside does not, so nothing pulls. None where an
    edge is not there (covered, or cut by the picture's border).
    """
    reach = min(0.9 * _side_px(corners) / CELLS, REACH_MAX_PX)
    lines = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        line = _edge(grey, start.astype(np.float64), end.astype(np.float64), reach)
        if line is None:
            return None
        lines.append(line)
    meeting = [
        np.linalg.solve(np.stack([a[0], b[0]]), [a[1], b[1]]) for a, b in zip([lines[-1], *lines], lines, strict=False)
    ]
    refined = np.array(meeting)
    moved = np.linalg.norm(refined - corners, axis=1).max()
    return refined.astype(np.float32) if moved <= reach else None


def _edge(
    grey: NDArray[np.uint8], start: NDArray[np.float64], end: NDArray[np.float64], reach: float
) -> tuple[NDArray[np.float64], float] | None:
    """The line n . x = d of one edge, brightness rising along n; None where too little of it is seen."""
    along = end - start
    length = float(np.linalg.norm(along))
    outward = np.array([along[1], -along[0]]) / length
    places = np.linspace(0.12, 0.88, max(round(length), 8))
    offsets = np.arange(-reach, reach + 1e-9, STEP_PX)
    points = (start + places[:, None, None] * along + offsets[None, :, None] * outward).astype(np.float32)
    profile = cv2.remap(grey, points[..., 0], points[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    rise = np.clip(np.diff(profile, axis=1), 0.0, None)
    strength = rise.sum(1)
    seen = strength > 0.4 * np.median(strength)
    if np.median(strength) < RISE_MIN or seen.sum() < 6:
        return None
    middle = 0.5 * (offsets[:-1] + offsets[1:])
    at = (rise * middle).sum(1)[seen] / strength[seen]
    where = places[seen]
    keep = np.ones(len(at), bool)
    for _ in range(2):  # once more without what lies off the line
        slope, level = np.polyfit(where[keep], at[keep], 1)
        off = np.abs(at - slope * where - level)
        keep = off <= max(3.0 * float(np.median(off)), 0.05)
    first, last = (start + share * along + (slope * share + level) * outward for share in (0.0, 1.0))
    direction = (last - first) / np.linalg.norm(last - first)
    normal = np.array([direction[1], -direction[0]])
    return normal, float(normal @ first)


def _around(last: list[NDArray[np.float32]], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """A window around where both markers were, wide enough for what moves between two pictures."""
    points = np.concatenate(last)
    margin = 1.5 * max(_side_px(one) for one in last)
    low = np.maximum(points.min(0) - margin, 0).astype(int)
    high = np.minimum(points.max(0) + margin, (shape[1], shape[0])).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _side_px(corners: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
