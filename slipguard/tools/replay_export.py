"""Export of recordings to CSV tables, PNG images and MP4 videos, with their configuration and background images."""

from __future__ import annotations

import csv
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FINGERS
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate
from slipguard.recording import messages as m
from slipguard.recording.reader import RecordedItem, Recording, StoredImage, StoredMessage
from slipguard.tools.replay import items_of

VIDEO_FPS = 30.0
GAP_MAX_NS = 600 * 10**9
"""A longer time without any message is left out of a video; the clock may have been set."""
FRAME_SIZE = (240, 320)
CONTOUR_BGR = (80, 240, 80)
ESTIMATE_COLUMNS = (
    "finger", "wall_ns", "sequence", "captured_at_s", "measured_at_s", "contact", "contact_area_px", "rotation_deg",
    "sigma_deg", "orientation_deg", "rate_deg_s", "shift_right_mm", "shift_up_mm", "skipped", "declined", "refused",
)  # fmt: skip
TICK_COLUMNS = (
    "wall_ns", "now_s", "phase", "rotation_deg", "sigma_deg", "rate_deg_s", "shift_mm", "force_n", "width_mm",
    "holding", "height_mm", "hold_force_n", "arm", "say", "fault",
)  # fmt: skip


def export(opened: list[Recording], folder: Path, kinds: set[str]) -> list[Path]:
    """Write the given kinds ("csv", "png", "mp4") into `folder`; return the files, or the folder of many images.

    The configuration and the background images are always written, since the other files cannot be understood or
    measured again without them.

    Raises InputError if the folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: cannot create the folder: {error.strerror}") from None
    written = _write_attachments(opened, folder)
    if "csv" in kinds:
        written += _write_tables(items_of(opened), folder)
    if "png" in kinds:
        written += _write_images(items_of(opened), folder)
    if "mp4" in kinds:
        written += _write_videos(opened, folder)
    return written


def _write_attachments(opened: list[Recording], folder: Path) -> list[Path]:
    """Write configuration and background images; one that differs from that of an earlier recording, under its name."""
    written: dict[Path, bytes] = {}
    for recording in opened:
        for name, content in recording.attachments.items():
            path = folder / Path(name).name
            if written.get(path, content) != content:
                path = folder / f"{recording.path.stem}-{path.name}"
            path.write_bytes(content)
            written[path] = content
    return list(written)


def _write_tables(items: Iterable[RecordedItem], folder: Path) -> list[Path]:
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


def _estimate_row(item: RecordedItem, record: m.FrameRecord) -> list[Any]:
    finger = item.topic.split("/")[1]
    head = [finger, item.at_ns, record.sequence, record.captured_at_s]
    e = record.estimate
    if e is None:
        return [*head, *[None] * 11, record.refused]
    right_mm, up_mm = e.shift_mm if e.shift_mm is not None else (None, None)
    values = [
        e.measured_at_s,
        e.contact,
        e.contact_area_px,
        e.rotation_deg,
        e.sigma_deg,
        e.orientation_deg,
        e.rate_deg_s,
    ]
    return [*head, *values, right_mm, up_mm, e.skipped, e.declined, None]


def _tick_row(item: RecordedItem, tick: m.CycleRecord) -> list[Any]:
    fused, gripper, arm, output = tick.observation.fused, tick.observation.gripper, tick.observation.arm, tick.output
    rotation = (
        [fused.rotation_deg, fused.sigma_deg, fused.rate_deg_s, fused.shift_mm] if fused is not None else [None] * 4
    )
    grip = [gripper.force_n, gripper.width_mm, gripper.holding] if gripper is not None else [None] * 3
    height_mm = arm.height_mm if arm is not None else None
    fault = str(output.fault) if output.fault is not None else None
    commanded = [output.hold_force_n, output.arm, output.text, fault]
    return [item.at_ns, tick.now_s, tick.phase, *rotation, *grip, height_mm, *commanded]


def _write_images(items: Iterable[RecordedItem], folder: Path) -> list[Path]:
    folders = {source: folder / source for source in m.IMAGE_TOPIC}
    for item in items:
        if isinstance(item.value, StoredImage) and item.topic == m.IMAGE_TOPIC[item.value.source]:
            target = folders[item.value.source]
            target.mkdir(exist_ok=True)
            cv2.imwrite(str(target / f"{item.at_ns}.png"), item.value.pixels())
    return [path for path in folders.values() if path.is_dir()]


def _write_videos(opened: list[Recording], folder: Path) -> list[Path]:
    """Write one video per finger with contour, rotation and force, at 30 images per second of wall-clock time."""
    written = []
    for finger in FINGERS:
        path = folder / f"{finger}.mp4"
        video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), VIDEO_FPS, FRAME_SIZE)
        if not video.isOpened():
            raise InputError(f"{path}: this OpenCV cannot write MP4. Export with --as png")
        try:
            _write_video(items_of(opened), finger, video)
        finally:
            video.release()
        written.append(path)
    return written


def _write_video(items: Iterable[RecordedItem], finger: str, video: cv2.VideoWriter) -> None:
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
        elif isinstance(value, m.FrameRecord) and item.topic == m.FRAME_TOPIC[finger]:
            estimate = value.estimate
        elif isinstance(value, m.CycleRecord) and value.observation.gripper is not None:
            force_n = value.observation.gripper.force_n
        if image is None:
            continue
        if next_ns is None or item.at_ns - next_ns > GAP_MAX_NS:
            next_ns = item.at_ns
        while item.at_ns >= next_ns:
            video.write(_annotated(image, mask, estimate, force_n))
            next_ns += round(1e9 / VIDEO_FPS)


def _annotated(
    image: NDArray[np.uint8], mask: NDArray[np.uint8] | None, estimate: Estimate | None, force_n: float | None
) -> NDArray[np.uint8]:
    drawing = cv2.resize(image, FRAME_SIZE).copy()
    if mask is not None:
        contours, _ = cv2.findContours(mask[..., 0], cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
        cv2.drawContours(drawing, contours, -1, CONTOUR_BGR, 1)
    lines_of_text = []
    if estimate is not None and estimate.rotation_deg is not None and estimate.sigma_deg is not None:
        lines_of_text.append(f"{estimate.rotation_deg:+.1f} +- {estimate.sigma_deg:.1f} deg")
    elif estimate is not None:
        lines_of_text.append(estimate.declined or "no reference")
    if force_n is not None:
        lines_of_text.append(f"{force_n:.0f} N")
    for line, text in enumerate(lines_of_text):
        where = (6, FRAME_SIZE[1] - 10 - 18 * line)
        for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
            cv2.putText(drawing, text, where, cv2.FONT_HERSHEY_SIMPLEX, 0.45, color, thickness, cv2.LINE_AA)
    return np.asarray(drawing, np.uint8)
