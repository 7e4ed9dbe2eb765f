"""The two printed markers of an experiment: their sheets at true scale, and their corners in an image."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.tools import plotting

DICTIONARY = cv2.aruco.DICT_4X4_50
GRIPPER_ID, OBJECT_ID = 0, 1
NAMES = {GRIPPER_ID: "gripper", OBJECT_ID: "object"}
SIDE_MM = 40.0
"""Side of the black square: 40 pixels at 1 m and a focal length of 1000 px."""
CHARUCO_SQUARES = (7, 5)
CHARUCO_SQUARE_MM, CHARUCO_MARKER_MM = 35.0, 28.0
A4_MM = (297.0, 210.0)
MM_PER_INCH = 25.4


@dataclass(frozen=True, slots=True)
class PrintSheet:
    """A page. images: gray image, x and y of its lower left corner, width, all mm. labels: x, y, text."""

    title: str
    images: tuple[tuple[NDArray[np.uint8], float, float, float], ...]
    labels: tuple[tuple[float, float, str], ...]


def cells(marker_id: int) -> NDArray[np.uint8]:
    """Return a marker's cells, (6, 6) uint8 of 0 and 1, black border included."""
    image = cv2.aruco.generateImageMarker(dictionary(), marker_id, 6)
    return np.asarray(image > 127, np.uint8)


def dictionary() -> cv2.aruco.Dictionary:
    return cv2.aruco.getPredefinedDictionary(DICTIONARY)


def charuco() -> cv2.aruco.CharucoBoard:
    """Return the board for camera calibration; its marker ids differ from the experiment's."""
    ids = np.arange(10, 10 + CHARUCO_SQUARES[0] * CHARUCO_SQUARES[1] // 2)
    return cv2.aruco.CharucoBoard(CHARUCO_SQUARES, CHARUCO_SQUARE_MM, CHARUCO_MARKER_MM, dictionary(), ids)


def marker_sheet() -> PrintSheet:
    """Return a sheet with both markers, twice each, and a ruler to check the printed scale."""
    images = []
    labels = []
    for column, marker_id in enumerate((GRIPPER_ID, OBJECT_ID)):
        for row in range(2):
            x_mm, y_mm = 30.0 + 130.0 * column, 40.0 + 75.0 * row
            image = cv2.aruco.generateImageMarker(dictionary(), marker_id, 600)
            images.append((np.asarray(image, np.uint8), x_mm, y_mm, SIDE_MM))
            labels.append((x_mm + SIDE_MM + 8.0, y_mm + SIDE_MM / 2, f"{NAMES[marker_id]} (id {marker_id})"))
    title = (
        f"slipguard evaluate: markers, black squares {SIDE_MM:g} mm. Print at 100 %, cut with a white margin of 7 mm, "
        "glue flat."
    )
    return PrintSheet(title, tuple(images), tuple(labels))


def charuco_sheet() -> PrintSheet:
    across, up = CHARUCO_SQUARES
    image = charuco().generateImage((across * 200, up * 200))
    title = (
        f"slipguard evaluate calibrate-camera: squares {CHARUCO_SQUARE_MM:g} mm. Print at 100 %, glue to a flat board."
    )
    return PrintSheet(title, ((np.asarray(image, np.uint8), 26.0, 18.0, across * CHARUCO_SQUARE_MM),), ())


def write_sheet(sheet: PrintSheet, path: Path) -> None:
    """Write A4 landscape at true scale, as PDF or PNG (300 dpi) by the suffix. Raises InputError for another."""
    if path.suffix.lower() not in (".pdf", ".png"):
        raise InputError(f"{path}: unknown format; use .pdf or .png")
    page = plotting.figure(A4_MM[0] / MM_PER_INCH, A4_MM[1] / MM_PER_INCH)
    page.set_layout_engine("none")
    for image, x_mm, y_mm, width_mm in sheet.images:
        height_mm = width_mm * image.shape[0] / image.shape[1]
        axes = page.add_axes((x_mm / A4_MM[0], y_mm / A4_MM[1], width_mm / A4_MM[0], height_mm / A4_MM[1]))
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest", aspect="auto")
        axes.axis("off")
    for x_mm, y_mm, text in sheet.labels:
        page.text(x_mm / A4_MM[0], y_mm / A4_MM[1], text, fontsize=10, va="center")
    page.text(0.05, 1.0 - 8.0 / A4_MM[1], sheet.title, fontsize=8, va="top")
    _ruler(page)
    plotting.save(page, path, dpi=300)


def _ruler(page: object) -> None:
    axes = page.add_axes((20.0 / A4_MM[0], 4.0 / A4_MM[1], 100.0 / A4_MM[0], 8.0 / A4_MM[1]))  # type: ignore[attr-defined]
    axes.set_xlim(0.0, 100.0)
    axes.set_ylim(0.0, 8.0)
    axes.axis("off")
    for x_mm in range(0, 101, 10):
        axes.plot([x_mm, x_mm], [0.0, 3.0 if x_mm % 50 else 5.0], color="black", linewidth=0.6, clip_on=False)
    axes.plot([0.0, 100.0], [0.0, 0.0], color="black", linewidth=0.6, clip_on=False)
    axes.text(102.0, 1.0, "100 mm", fontsize=7)


SIDE_MIN_PX = 12.0
"""Smaller markers are unreliable, and their rotation is not accurate to a degree."""
FIND_BLUR_PX = 0.8
"""Blur for detection, because noise causes hundreds of false candidates; corners are refined without it."""
CELLS = 6
REACH_MAX_PX = 6.0
STEP_PX = 0.25
RISE_MIN = 25.0
"""Minimum rise from black to white of an edge, gray levels."""


@dataclass(frozen=True, slots=True, eq=False)
class MarkerCorners:
    """Corners (4, 2) in pixels, clockwise from the marker's upper left; None if the marker was not found."""

    time_s: float
    gripper_px: NDArray[np.float32] | None
    object_px: NDArray[np.float32] | None


class MarkerDetector:
    """Finds both markers, first near their last position; not thread-safe."""

    def __init__(self) -> None:
        self._detector = cv2.aruco.ArucoDetector(dictionary(), cv2.aruco.DetectorParameters())
        self._last: list[NDArray[np.float32]] = []

    def detect(self, image: NDArray[np.uint8], time_s: float) -> MarkerCorners:
        """Return the corners in an image, (h, w, 3) or (h, w) uint8. A marker found twice counts as not found."""
        gray = np.asarray(image if image.ndim == 2 else cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), np.uint8)
        found = self._find(gray, _around(self._last, gray.shape)) if self._last else {}
        if len(found) < 2:
            found = self._find(gray, (0, 0, gray.shape[1], gray.shape[0]))
        self._last = list(found.values()) if len(found) == 2 else []
        refined = {marker_id: refined_corners(gray, corners) for marker_id, corners in found.items()}
        return MarkerCorners(time_s, refined.get(GRIPPER_ID), refined.get(OBJECT_ID))

    def _find(self, gray: NDArray[np.uint8], window: tuple[int, int, int, int]) -> dict[int, NDArray[np.float32]]:
        left, top, right, bottom = window
        part = cv2.GaussianBlur(gray[top:bottom, left:right], (0, 0), FIND_BLUR_PX)
        corners, ids, _ = self._detector.detectMarkers(part)
        found: dict[int, list[NDArray[np.float32]]] = {GRIPPER_ID: [], OBJECT_ID: []}
        for marker_id, corner in zip([] if ids is None else ids.ravel(), corners, strict=True):
            if int(marker_id) in found:
                here = np.asarray(corner, np.float32).reshape(4, 2) + np.array([left, top], np.float32)
                found[int(marker_id)].append(here)
        return {
            marker_id: one[0] for marker_id, one in found.items() if len(one) == 1 and _side_px(one[0]) >= SIDE_MIN_PX
        }


def refined_corners(gray: NDArray[np.uint8], corners: NDArray[np.float32]) -> NDArray[np.float32] | None:
    """Return the corners (4, 2) as intersections of straight lines through the edges of the black square.

    All edge pixels are used, so noise averages out. None if an edge is missing (covered, or outside the image).
    """
    reach = min(0.9 * _side_px(corners) / CELLS, REACH_MAX_PX)
    lines = []
    for start, end in zip(corners, np.roll(corners, -1, axis=0), strict=True):
        line = _edge(gray, start.astype(np.float64), end.astype(np.float64), reach)
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
    gray: NDArray[np.uint8], start: NDArray[np.float64], end: NDArray[np.float64], reach: float
) -> tuple[NDArray[np.float64], float] | None:
    """Return the line n . x = d of one edge, brightness rising along n; None if too little of it is visible."""
    along = end - start
    length = float(np.linalg.norm(along))
    outward = np.array([along[1], -along[0]]) / length
    places = np.linspace(0.12, 0.88, max(round(length), 8))
    offsets = np.arange(-reach, reach + 1e-9, STEP_PX)
    points = (start + places[:, None, None] * along + offsets[None, :, None] * outward).astype(np.float32)
    profile = cv2.remap(gray, points[..., 0], points[..., 1], cv2.INTER_LINEAR).astype(np.float64)
    rise = np.clip(np.diff(profile, axis=1), 0.0, None)
    strength = rise.sum(1)
    seen = strength > 0.4 * np.median(strength)
    if np.median(strength) < RISE_MIN or seen.sum() < 6:
        return None
    middle = 0.5 * (offsets[:-1] + offsets[1:])
    at = (rise * middle).sum(1)[seen] / strength[seen]
    where = places[seen]
    keep = np.ones(len(at), bool)
    for _ in range(2):  # the second time without outliers
        slope, level = np.polyfit(where[keep], at[keep], 1)
        off = np.abs(at - slope * where - level)
        keep = off <= max(3.0 * float(np.median(off)), 0.05)
    first, last = (start + share * along + (slope * share + level) * outward for share in (0.0, 1.0))
    direction = (last - first) / np.linalg.norm(last - first)
    normal = np.array([direction[1], -direction[0]])
    return normal, float(normal @ first)


def _around(last: list[NDArray[np.float32]], shape: tuple[int, ...]) -> tuple[int, int, int, int]:
    """Return a window around the last positions of both markers, with a margin for motion between images."""
    points = np.concatenate(last)
    margin = 1.5 * max(_side_px(one) for one in last)
    low = np.maximum(points.min(0) - margin, 0).astype(int)
    high = np.minimum(points.max(0) + margin, (shape[1], shape[0])).astype(int)
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def _side_px(corners: NDArray[np.float32]) -> float:
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1).max())
