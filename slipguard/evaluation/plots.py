"""The experiment's three pictures: error per object, turn over time, what was segmented."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from slipguard.errors import InputError
from slipguard.evaluation.analyse import LiftResult, mask_of
from slipguard.evaluation.lift_data import LiftData, read_lift
from slipguard.evaluation.marker_rotation import RotationTrace
from slipguard.evaluation.summary import PAPER, by_object, errors_of
from slipguard.tools import plotting as figures

INK, PALE, SEEN, UNSEEN, TRUTH = "#1d2733", "#c9d1da", "#c9862b", "#2f6f9f", "#5b9e5b"
EXAMPLES = 9
SEGMENTED = 6
OURS_BGR, THEIRS_BGR = (60, 220, 255), (90, 230, 90)


def draw_errors(lifts: list[LiftResult], path: Path) -> None:
    """A box of lift means for every object, each lift a dot, the published figure behind them."""
    objects = by_object(lifts)
    page = figures.figure(8.0, 3.6)
    axes = page.add_subplot()
    mean, sd = PAPER["turn_error_mean_deg"], PAPER["turn_error_sd_deg"]
    axes.axhspan(mean - sd, mean + sd, color=PALE, alpha=0.5, lw=0)
    axes.axhline(mean, color=INK, lw=0.8, ls=":")
    axes.annotate(
        f"real cell, as published: {mean:.2f}° ± {sd:.2f}°", (0.995, mean), xycoords=("axes fraction", "data"),
        ha="right", va="bottom", fontsize=8, color=INK,
    )  # fmt: skip
    rng = np.random.default_rng(0)
    for place, one in enumerate(objects):
        values = errors_of([lift for lift in lifts if lift.object == one.name], "fused")
        colour = SEEN if one.seen else UNSEEN
        if not values:
            axes.annotate("no angle\ntold", (place, 0.05), ha="center", va="bottom", fontsize=8, color=INK)
            continue
        box = axes.boxplot([values], positions=[place], widths=0.55, showfliers=False, patch_artist=True)
        for part in (*box["boxes"], *box["whiskers"], *box["caps"], *box["medians"]):
            part.set_color(colour)
        box["boxes"][0].set_facecolor((1, 1, 1, 0.8))
        axes.plot(place + rng.uniform(-0.12, 0.12, len(values)), values, ".", color=colour, ms=5, alpha=0.8)
    names = [one.name.replace("_", " ") + (f"\n({one.hard})" if one.hard else "") for one in objects]
    axes.set_xticks(range(len(objects)), names, fontsize=8)
    axes.set_ylim(0.0, None)
    axes.set_ylabel("mean error of a lift, degrees")
    axes.plot([], [], "s", color=UNSEEN, label="unseen in training")
    if any(one.seen for one in objects):
        axes.plot([], [], "s", color=SEEN, label="seen in training")
    axes.legend(loc="upper left", fontsize=8, frameon=False)
    _plain(axes)
    figures.save(page, path)


def draw_curves(lifts: list[LiftResult], path: Path) -> None:
    """Turn over time for one lift of each object: what slipguard said, what the markers say, the truth if known."""
    chosen = _one_each(lifts)[:EXAMPLES]
    columns = 3
    rows = max(-(-len(chosen) // columns), 1)
    page = figures.figure(8.0, 2.1 * rows)
    for number, lift in enumerate(chosen):
        axes = page.add_subplot(rows, columns, number + 1)
        looks = (("truth", TRUTH, 3.0, "-"), ("markers", INK, 1.0, "-"), ("fused", SEEN, 1.2, "--"))
        for name, colour, width, style in looks:
            if name in lift.curves and lift.curves[name][0]:
                time_s, rotation_deg = (np.asarray(part) for part in lift.curves[name])
                shown = time_s >= -0.3
                axes.plot(time_s[shown], rotation_deg[shown], style, color=colour, lw=width, label=_LABELS[name])
        mean = lift.errors["fused"].mean_deg if "fused" in lift.errors else None
        told = f"{mean:.2f}°" if mean is not None else "not told"
        axes.set_title(f"{lift.object.replace('_', ' ')}, lift {lift.repeat + 1}: error {told}", fontsize=8)
        axes.tick_params(labelsize=7)
        if number == 0:
            axes.legend(fontsize=7, frameon=False)
        if number % columns == 0:
            axes.set_ylabel("turn, °", fontsize=8)
        if number >= len(chosen) - columns:
            axes.set_xlabel("seconds since the lift began", fontsize=8)
        _plain(axes)
    figures.save(page, path)


_LABELS = {"truth": "truth", "markers": "markers", "fused": "slipguard"}


def draw_masks(folder: Path, lifts: list[LiftResult], path: Path) -> bool:
    """Gel image, outline wanted and outline found, for some objects; False where no true masks are recorded."""
    shown: list[tuple[str, NDArray[np.uint8]]] = []
    for lift in _one_each(lifts):
        if len(shown) == SEGMENTED:
            break
        try:
            strip = _strip(read_lift(folder / f"{lift.stem}.mcap"))
        except InputError:
            continue
        if strip is not None:
            shown.append((lift.object.replace("_", " "), strip))
    if not shown:
        return False
    page = figures.figure(8.0, 1.75 * -(-len(shown) // 2))
    for number, (name, strip) in enumerate(shown):
        axes = page.add_subplot(-(-len(shown) // 2), 2, number + 1)
        axes.imshow(cv2.cvtColor(strip, cv2.COLOR_BGR2RGB))
        axes.set_title(f"{name}: image, outline wanted (green), found (yellow)", fontsize=8)
        axes.axis("off")
    figures.save(page, path)
    return True


def _strip(data: LiftData) -> NDArray[np.uint8] | None:
    """Image | with the true outline | with ours, of the left finger's last frame that has all three."""
    images = {one.judged.captured_at_s: one.picture for one in data.fingers["left"] if one.picture is not None}
    times = np.array(list(images))
    found = np.array([one.time_s for one in data.masks["left"]])
    if not len(times) or not len(found):
        return None
    for true in reversed(data.true_masks["left"]):
        beside = int(np.argmin(np.abs(found - true.time_s)))
        nearest = times[int(np.argmin(np.abs(times - found[beside])))]
        if abs(found[beside] - true.time_s) < 0.012 and abs(nearest - found[beside]) < 1e-3:
            picture = images[nearest]
            assert picture is not None
            image = picture.pixels()
            wanted = _outlined(image, mask_of(true), THEIRS_BGR)
            ours = _outlined(image, mask_of(data.masks["left"][beside]), OURS_BGR)
            return np.asarray(np.hstack([image, wanted, ours])[40:280], np.uint8)
    return None


def _outlined(image: NDArray[np.uint8], mask: NDArray[np.bool_], colour: tuple[int, int, int]) -> NDArray[np.uint8]:
    outlines, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    drawn = image.copy()
    cv2.drawContours(drawn, outlines, -1, colour, 2)
    return drawn


def _one_each(lifts: list[LiftResult]) -> list[LiftResult]:
    """Of each object the lift whose error is the middle one: neither the best nor the worst."""
    chosen = []
    for name in dict.fromkeys(lift.object for lift in lifts):
        own = [lift for lift in lifts if lift.object == name]
        ranked = sorted(own, key=_fused_error)
        chosen.append(ranked[len(ranked) // 2])
    return chosen


def _fused_error(lift: LiftResult) -> float:
    mean = lift.errors["fused"].mean_deg if "fused" in lift.errors else None
    return float("inf") if mean is None else mean


def draw_trace(trace: RotationTrace, path: Path) -> None:
    """One turn over time with its sigma."""
    page = figures.figure(7.0, 3.0)
    axes = page.add_subplot()
    low, high = trace.rotation_deg - trace.sigma_deg, trace.rotation_deg + trace.sigma_deg
    axes.fill_between(trace.time_s, low, high, color=PALE, lw=0)
    axes.plot(trace.time_s, trace.rotation_deg, ".-", color=INK, lw=0.8, ms=3)
    axes.set_xlabel("seconds")
    axes.set_ylabel("turn, °")
    _plain(axes)
    figures.save(page, path)


def _plain(axes: Any) -> None:
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
