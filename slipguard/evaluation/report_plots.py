"""The figures of a report: error per object, rotation over time, segmentation."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.lift_analysis import LiftResult, mask_of
from slipguard.evaluation.lift_recording import LiftData, read_lift
from slipguard.evaluation.marker_rotation import RotationTrace
from slipguard.evaluation.report_data import PAPER, by_object, errors_of
from slipguard.tools import plotting

INK, PALE, SEEN, UNSEEN, TRUTH = "#1d2733", "#c9d1da", "#c9862b", "#2f6f9f", "#5b9e5b"
EXAMPLES = 9
MASK_EXAMPLES = 6
SEGMENTED_BGR, TRUE_BGR = (60, 220, 255), (90, 230, 90)


def draw_errors(lifts: list[LiftResult], path: Path) -> None:
    """Draw a box of lift means for every object, each lift a dot, with the paper's result as a band."""
    objects = by_object(lifts)
    page = plotting.figure(8.0, 3.6)
    axes = page.add_subplot()
    mean, sd = PAPER["turn_error_mean_deg"], PAPER["turn_error_sd_deg"]
    note = " (these lifts are simulated; not comparable)" if all(lift.simulated for lift in lifts) else ""
    axes.axhspan(mean - sd, mean + sd, color=PALE, alpha=0.5, lw=0)
    axes.axhline(mean, color=INK, lw=0.8, ls=":")
    axes.annotate(
        f"paper, real cell: {mean:.2f}° ± {sd:.2f}°{note}", (0.995, mean), xycoords=("axes fraction", "data"),
        ha="right", va="bottom", fontsize=8, color=INK,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    for place, own in enumerate(objects.values()):
        values = errors_of(own)
        color = SEEN if own[0].seen else UNSEEN
        if not values:
            axes.annotate("no\nestimate", (place, 0.05), ha="center", va="bottom", fontsize=8, color=INK)
            continue
        box = axes.boxplot([values], positions=[place], widths=0.55, showfliers=False, patch_artist=True)
        for part in (*box["boxes"], *box["whiskers"], *box["caps"], *box["medians"]):
            part.set_color(color)
        box["boxes"][0].set_facecolor((1, 1, 1, 0.8))
        axes.plot(place + rng.uniform(-0.12, 0.12, len(values)), values, ".", color=color, ms=5, alpha=0.8)
    names = [name.replace("_", " ") + (f"\n({own[0].hard})" if own[0].hard else "") for name, own in objects.items()]
    axes.set_xticks(range(len(objects)), names, fontsize=8)
    axes.set_ylim(0.0, None)
    axes.set_ylabel("mean error of a lift, degrees")
    axes.plot([], [], "s", color=UNSEEN, label="unseen in training")
    if any(lift.seen for lift in lifts):
        axes.plot([], [], "s", color=SEEN, label="seen in training")
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    _plain(axes)
    plotting.save(page, path)


def draw_curves(lifts: list[LiftResult], path: Path) -> None:
    """Draw rotation over time for one lift of each object: slipguard's estimate, the markers, the truth if known."""
    chosen = _median_lifts(lifts)[:EXAMPLES]
    columns = 3
    rows = max(-(-len(chosen) // columns), 1)
    page = plotting.figure(8.0, 2.1 * rows)
    for number, lift in enumerate(chosen):
        axes = page.add_subplot(rows, columns, number + 1)
        styles = (("truth", TRUTH, 3.0, "-"), ("markers", INK, 1.0, "-"), ("fused", SEEN, 1.2, "--"))
        for name, color, width, style in styles:
            if name in lift.curves and lift.curves[name][0]:
                time_s, rotation_deg = (np.asarray(part) for part in lift.curves[name])
                shown = time_s >= -0.3
                axes.plot(time_s[shown], rotation_deg[shown], style, color=color, lw=width, label=_LABELS[name])
        mean = lift.errors["fused"].mean_deg if "fused" in lift.errors else None
        error = f"{mean:.2f}°" if mean is not None else "no estimate"
        axes.set_title(f"{lift.object.replace('_', ' ')}, lift {lift.repeat + 1}: error {error}", fontsize=8)
        axes.tick_params(labelsize=7)
        if number == 0:
            axes.legend(fontsize=7, frameon=False)
        if number % columns == 0:
            axes.set_ylabel("rotation, °", fontsize=8)
        if number >= len(chosen) - columns:
            axes.set_xlabel("time since the lift began, s", fontsize=8)
        _plain(axes)
    plotting.save(page, path)


_LABELS = {"truth": "truth", "markers": "markers", "fused": "slipguard"}


def draw_masks(folder: Path, lifts: list[LiftResult], path: Path) -> bool:
    """Draw gel image, true contour and segmented contour for some objects; return False without true masks."""
    shown: list[tuple[str, NDArray[np.uint8]]] = []
    for lift in _median_lifts(lifts):
        if len(shown) == MASK_EXAMPLES:
            break
        try:
            strip = _strip(read_lift(folder / f"{lift.stem}.mcap"))
        except InputError:
            continue
        if strip is not None:
            shown.append((lift.object.replace("_", " "), strip))
    if not shown:
        return False
    page = plotting.figure(8.0, 1.75 * -(-len(shown) // 2))
    for number, (name, strip) in enumerate(shown):
        axes = page.add_subplot(-(-len(shown) // 2), 2, number + 1)
        axes.imshow(cv2.cvtColor(strip, cv2.COLOR_BGR2RGB))
        axes.set_title(f"{name}: image, true contour (green), segmented (yellow)", fontsize=8)
        axes.axis("off")
    plotting.save(page, path)
    return True


def _strip(data: LiftData) -> NDArray[np.uint8] | None:
    """Return image | with true contour | with segmented contour, of the left finger's last frame that has all three."""
    images = {one.record.captured_at_s: one.image for one in data.fingers["left"] if one.image is not None}
    times = np.array(list(images))
    found = np.array([one.time_s for one in data.masks["left"]])
    if not len(times) or not len(found):
        return None
    for true in reversed(data.true_masks["left"]):
        match = int(np.argmin(np.abs(found - true.time_s)))
        nearest = times[int(np.argmin(np.abs(times - found[match])))]
        if abs(found[match] - true.time_s) < 0.012 and abs(nearest - found[match]) < 1e-3:
            image = images[nearest].pixels()
            true_contour = _with_contour(image, mask_of(true), TRUE_BGR)
            segmented = _with_contour(image, mask_of(data.masks["left"][match]), SEGMENTED_BGR)
            return np.asarray(np.hstack([image, true_contour, segmented])[40:280], np.uint8)
    return None


def _with_contour(image: NDArray[np.uint8], mask: NDArray[np.bool_], color: tuple[int, int, int]) -> NDArray[np.uint8]:
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    drawn = image.copy()
    cv2.drawContours(drawn, contours, -1, color, 2)
    return drawn


def _median_lifts(lifts: list[LiftResult]) -> list[LiftResult]:
    """Return the lift with the median error of each object."""
    return [sorted(own, key=_fused_error)[len(own) // 2] for own in by_object(lifts).values()]


def _fused_error(lift: LiftResult) -> float:
    mean = lift.errors["fused"].mean_deg if "fused" in lift.errors else None
    return float("inf") if mean is None else mean


def draw_trace(trace: RotationTrace, path: Path) -> None:
    page = plotting.figure(7.0, 3.0)
    axes = page.add_subplot()
    low, high = trace.rotation_deg - trace.sigma_deg, trace.rotation_deg + trace.sigma_deg
    axes.fill_between(trace.time_s, low, high, color=PALE, lw=0)
    axes.plot(trace.time_s, trace.rotation_deg, ".-", color=INK, lw=0.8, ms=3)
    axes.set_xlabel("time, s")
    axes.set_ylabel("rotation, °")
    _plain(axes)
    plotting.save(page, path)


def _plain(axes: Any) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
