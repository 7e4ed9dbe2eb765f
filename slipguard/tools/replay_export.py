"""A recording taken apart into files any program reads: tables, pictures, films."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate
from slipguard.recording import messages as m
from slipguard.recording.reader import RecordedItem, Recording, StoredImage, StoredMessage
from slipguard.tools.replay import items_of

FILM_FPS = 30.0
FRAME_SIZE = (240, 320)
OUTLINE_BGR = (80, 240, 80)
ESTIMATE_COLUMNS = (
    "finger", "wall_ns", "sequence", "captured_at_s", "measured_at_s", "contact", "contact_area_px", "angle_deg",
    "sigma_deg", "orientation_deg", "rate_deg_s", "shift_right_mm", "shift_up_mm", "skipped", "declined", "refused",
)  # fmt: skip
TICK_COLUMNS = (
    "wall_ns", "now_s", "phase", "rotation_deg", "sigma_deg", "rate_deg_s", "shift_mm", "force_n", "width_mm", "holding",
    "height_mm", "hold_force_n", "arm", "say", "fault",
)  # fmt: skip


def export(opened: list[Recording], folder: Path, kinds: set[str]) -> list[Path]:
    """Write what is asked for ("csv", "png", "mp4") into `folder`; returns the files, a folder for many pictures.

    Raises InputError where the folder cannot be used.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot be made ({error.strerror})") from None
    written: list[Path] = []
    if "csv" in kinds:
        written += _tables(items_of(opened), folder)
    if "png" in kinds:
        written += _pictures(items_of(opened), folder)
    if "mp4" in kinds:
        written += _films(opened, folder)
    return written


def _tables(items: Iterable[RecordedItem], folder: Path) -> list[Path]:
    paths = [folder / name for name in ("estimates.csv", "ticks.csv", "log.csv")]
    with paths[0].open("w", newline="") as first, paths[1].open("w", newline="") as second, paths[2].open("w") as third:
        estimates, ticks, log = (csv.writer(file) for file in (first, second, third))
        estimates.writerow(ESTIMATE_COLUMNS)
        ticks.writerow(TICK_COLUMNS)
        log.writerow(("wall_ns", "error", "text"))
        for item in items:
            if isinstance(item.value, m.FrameRecord):
                estimates.writerow(_estimate_row(item, item.value))
            elif isinstance(item.value, m.CycleRecord):
                ticks.writerow(_tick_row(item, item.value))
            elif isinstance(item.value, StoredMessage):
                log.writerow((item.at_ns, item.value.error, item.value.text))
    return paths


def _estimate_row(item: RecordedItem, judged: m.FrameRecord) -> list[Any]:
    finger = item.topic.split("/")[1]
    head = [finger, item.at_ns, judged.sequence, judged.captured_at_s]
    e = judged.estimate
    if e is None:
        return [*head, *[None] * 11, judged.refused]
    right_mm, up_mm = e.shift_mm if e.shift_mm is not None else (None, None)
    told = [e.measured_at_s, e.contact, e.contact_area_px, e.angle_deg, e.sigma_deg, e.orientation_deg, e.rate_deg_s]
    return [*head, *told, right_mm, up_mm, e.skipped, e.declined, None]


def _tick_row(item: RecordedItem, tick: m.CycleRecord) -> list[Any]:
    fused, gripper, arm, command = tick.observation.fused, tick.observation.gripper, tick.observation.arm, tick.command
    rotation = (
        [fused.rotation_deg, fused.sigma_deg, fused.rate_deg_s, fused.shift_mm] if fused is not None else [None] * 4
    )
    grip = [gripper.force_n, gripper.width_mm, gripper.holding] if gripper is not None else [None] * 3
    height_mm = arm.height_mm if arm is not None else None
    fault = str(command.fault) if command.fault is not None else None
    commanded = [command.hold_force_n, command.arm, command.say, fault]
    return [item.at_ns, tick.now_s, tick.phase, *rotation, *grip, height_mm, *commanded]


def _pictures(items: Iterable[RecordedItem], folder: Path) -> list[Path]:
    folders = {source: folder / source for source in m.IMAGE_TOPIC}
    for item in items:
        if isinstance(item.value, StoredImage) and item.topic == m.IMAGE_TOPIC[item.value.source]:
            home = folders[item.value.source]
            home.mkdir(exist_ok=True)
            cv2.imwrite(str(home / f"{item.at_ns}.png"), item.value.pixels())
    return [path for path in folders.values() if path.is_dir()]


def _films(opened: list[Recording], folder: Path) -> list[Path]:
    """One film of each finger: contact outlined, turn and force written in, at 30 pictures a second of wall clock."""
    written = []
    for finger in m.FINGERS:
        path = folder / f"{finger}.mp4"
        film = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), FILM_FPS, FRAME_SIZE)
        if not film.isOpened():
            raise InputError(f"{path}: this OpenCV cannot write MP4; export as png instead")
        try:
            _film(items_of(opened), finger, film)
        finally:
            film.release()
        written.append(path)
    return written


def _film(items: Iterable[RecordedItem], finger: str, film: cv2.VideoWriter) -> None:
    image: NDArray[np.uint8] | None = None
    mask: NDArray[np.uint8] | None = None
    estimate: Estimate | None = None
    force_n: float | None = None
    next_ns: int | None = None
    for item in items:
        value = item.value
        if isinstance(value, StoredImage) and value.source == finger:
            if item.topic == m.IMAGE_TOPIC[finger]:
                image, mask = value.pixels(), None
            else:
                mask = value.pixels()
        elif isinstance(value, m.FrameRecord) and item.topic == m.JUDGED_TOPIC[finger]:
            estimate = value.estimate
        elif isinstance(value, m.CycleRecord) and value.observation.gripper is not None:
            force_n = value.observation.gripper.force_n
        if image is None:
            continue
        next_ns = item.at_ns if next_ns is None else next_ns
        while item.at_ns >= next_ns:
            film.write(_drawn(image, mask, estimate, force_n))
            next_ns += round(1e9 / FILM_FPS)


def _drawn(
    image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, estimate: Estimate | None, force_n: float | None
) -> NDArray[np.uint8]:
    picture = cv2.resize(image, FRAME_SIZE).copy()
    if mask is not None:
        outlines, _ = cv2.findContours(mask[..., 0], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(picture, outlines, -1, OUTLINE_BGR, 1)
    words = []
    if estimate is not None and estimate.angle_deg is not None and estimate.sigma_deg is not None:
        words.append(f"{estimate.angle_deg:+.1f} +- {estimate.sigma_deg:.1f} deg")
    elif estimate is not None:
        words.append(estimate.declined or "no reference")
    if force_n is not None:
        words.append(f"{force_n:.0f} N")
    for line, text in enumerate(words):
        where = (6, FRAME_SIZE[1] - 10 - 18 * line)
        for colour, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(picture, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, thickness, cv2.LINE_AA)
    return np.asarray(picture, np.uint8)
