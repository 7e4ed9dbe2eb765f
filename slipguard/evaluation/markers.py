"""The two markers of an experiment, and sheets to print them from at true scale."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.tools import plotting as figures

DICTIONARY = cv2.aruco.DICT_4X4_50
GRIPPER_ID, OBJECT_ID = 0, 1
NAMES = {GRIPPER_ID: "gripper", OBJECT_ID: "object"}
SIDE_MM = 40.0
"""Of the black square. At 1 m and 1000 px focal length it is 40 pixels wide."""
CHARUCO_SQUARES = (7, 5)
CHARUCO_SQUARE_MM, CHARUCO_MARKER_MM = 35.0, 28.0
A4_MM = (297.0, 210.0)
MM_PER_INCH = 25.4


@dataclass(frozen=True, slots=True)
class PrintSheet:
    """A page: grey pictures with their lower left corner and width in millimetres, and a title."""

    title: str
    pictures: tuple[tuple[NDArray[np.uint8], float, float, float], ...]
    words: tuple[tuple[float, float, str], ...]


def cells(marker_id: int) -> NDArray[np.uint8]:
    """(6, 6) uint8 of 0 and 1, the black border included."""
    image = cv2.aruco.generateImageMarker(dictionary(), marker_id, 6)
    return np.asarray(image > 127, np.uint8)


def dictionary() -> cv2.aruco.Dictionary:
    """The dictionary both markers come from."""
    return cv2.aruco.getPredefinedDictionary(DICTIONARY)


def charuco() -> cv2.aruco.CharucoBoard:
    """The board for finding a camera's intrinsics; its markers are none of the experiment's."""
    ids = np.arange(10, 10 + CHARUCO_SQUARES[0] * CHARUCO_SQUARES[1] // 2)
    return cv2.aruco.CharucoBoard(CHARUCO_SQUARES, CHARUCO_SQUARE_MM, CHARUCO_MARKER_MM, dictionary(), ids)


def marker_sheet() -> PrintSheet:
    """Both markers twice, so that one may be spoilt, with a ruler to check the printer by."""
    pictures = []
    words = []
    for column, marker_id in enumerate((GRIPPER_ID, OBJECT_ID)):
        for row in range(2):
            x_mm, y_mm = 30.0 + 130.0 * column, 40.0 + 75.0 * row
            image = cv2.aruco.generateImageMarker(dictionary(), marker_id, 600)
            pictures.append((np.asarray(image, np.uint8), x_mm, y_mm, SIDE_MM))
            words.append((x_mm + SIDE_MM + 8.0, y_mm + SIDE_MM / 2, f"{NAMES[marker_id]} (id {marker_id})"))
    title = (
        f"slipguard evaluate: markers, black squares {SIDE_MM:g} mm. Print at 100 %, cut with a white margin of 7 mm, "
        "glue flat."
    )
    return PrintSheet(title, tuple(pictures), tuple(words))


def charuco_sheet() -> PrintSheet:
    """The calibration board."""
    across, up = CHARUCO_SQUARES
    image = charuco().generateImage((across * 200, up * 200))
    title = (
        f"slipguard evaluate calibrate-camera: squares {CHARUCO_SQUARE_MM:g} mm. Print at 100 %, glue to a flat board."
    )
    return PrintSheet(title, ((np.asarray(image, np.uint8), 26.0, 18.0, across * CHARUCO_SQUARE_MM),), ())


def write_sheet(sheet: PrintSheet, path: Path) -> None:
    """A4 landscape at true scale, PDF or PNG (300 dpi) by the ending. Raises InputError."""
    if path.suffix.lower() not in (".pdf", ".png"):
        raise InputError(f"{path}: sheets are written as .pdf or .png")
    page = figures.figure(A4_MM[0] / MM_PER_INCH, A4_MM[1] / MM_PER_INCH)
    page.set_layout_engine("none")
    for image, x_mm, y_mm, width_mm in sheet.pictures:
        height_mm = width_mm * image.shape[0] / image.shape[1]
        axes = page.add_axes((x_mm / A4_MM[0], y_mm / A4_MM[1], width_mm / A4_MM[0], height_mm / A4_MM[1]))
        axes.imshow(image, cmap="gray", vmin=0, vmax=255, interpolation="nearest", aspect="auto")
        axes.axis("off")
    for x_mm, y_mm, text in sheet.words:
        page.text(x_mm / A4_MM[0], y_mm / A4_MM[1], text, fontsize=10, va="center")
    page.text(0.05, 1.0 - 8.0 / A4_MM[1], sheet.title, fontsize=8, va="top")
    _ruler(page)
    figures.save(page, path, dpi=300)


def _ruler(page: object) -> None:
    """100 mm, to hold a real one against."""
    axes = page.add_axes((20.0 / A4_MM[0], 4.0 / A4_MM[1], 100.0 / A4_MM[0], 8.0 / A4_MM[1]))  # type: ignore[attr-defined]
    axes.set_xlim(0.0, 100.0)
    axes.set_ylim(0.0, 8.0)
    axes.axis("off")
    for x_mm in range(0, 101, 10):
        axes.plot([x_mm, x_mm], [0.0, 3.0 if x_mm % 50 else 5.0], color="black", linewidth=0.6, clip_on=False)
    axes.plot([0.0, 100.0], [0.0, 0.0], color="black", linewidth=0.6, clip_on=False)
    axes.text(102.0, 1.0, "100 mm", fontsize=7)
