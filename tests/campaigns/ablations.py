"""The value of each design choice of the small network: variants with one choice changed, on the same short schedule.

The variants are scored on presses of objects left out of these trainings, at frame size, each against its own label,
and on the tuning part of the real frames.
"""

from __future__ import annotations

import json
import time
import warnings
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from rich.console import Console

from slipguard.datasets.dataset_files import read_backgrounds
from slipguard.datasets.frame_cache import TrainingFrames
from slipguard.datasets.mask_scores import dice, iou
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.sim.contact_label import PRESS_SHARE
from slipguard.training.onnx_export import open_session
from slipguard.training.small_network import Inputs, ProbabilityNet, SmallNet
from slipguard.training.train import TrainSettings, frame_iou, probabilities, train
from tests.campaigns.ablation_frames import CONTACT, StoredFrames, held_out_frames, training_frames
from tests.campaigns.int8_export import CALIBRATION_FRAMES, CONVOLUTIONS, write_int8
from tests.campaigns.real_backgrounds import no_contact_frames
from tests.campaigns.real_frames import RealFrame, real_frames

HELD_OUT_FRAMES = 240
CROP_MARGIN_PX, CROP_STEP_PX = 12, 16
"""Margin around the known patch, at network resolution; crop sides are multiples of the network's stride."""
TIMED_ROUNDS = 150
THRESHOLD = 0.5


@dataclass(frozen=True, slots=True)
class Variant:
    """One choice changed. size: (width, height); mask: label threshold as a share of the deepest press, or CONTACT."""

    name: str
    mask: float | str = PRESS_SHARE
    inputs: Inputs = "both"
    size: tuple[int, int] = (120, 160)
    widths: tuple[int, int, int, int] = (16, 32, 64, 96)
    settings: TrainSettings = field(default=TrainSettings(epochs=2, patterns=300, zoom_share=0.1, threads=1))

    def net(self) -> SmallNet:
        """Return the untrained network of this variant."""
        return SmallNet(self.widths, self.inputs)


VARIANTS = (
    Variant("as shipped"),
    Variant("label: 10 % of the deepest press", mask=0.10),
    Variant("label: 20 %", mask=0.20),
    Variant("label: the contact itself", mask=CONTACT),
    Variant("input: change alone", inputs="change"),
    Variant("input: frame alone", inputs="frame"),
    Variant("channels: 8-16-32-48", widths=(8, 16, 32, 48)),
    Variant("channels: 24-48-96-144", widths=(24, 48, 96, 144)),
    Variant("no global context: 16-32-64", widths=(16, 32, 64, 0)),
    Variant("resolution: 96×128", size=(96, 128)),
    Variant("resolution: 240×320", size=(240, 320)),
)


def scores(net: SmallNet, variant: Variant, drawn: StoredFrames, real: list[RealFrame]) -> dict[str, float]:
    """Return Dice and IoU over held-out presses at frame size, and the IoU of each group of real frames."""
    masks = drawn.masks(variant.mask)
    shown = drawn.at(variant.size, masks)
    found = [
        dice_and_iou(probability, truth > 0)
        for start in range(0, len(drawn), 40)
        for probability, truth in zip(
            probabilities(net, shown.frame[start : start + 40], shown.background[start : start + 40], True).numpy(),
            masks[start : start + 40],
            strict=True,
        )
        if truth.any()
    ]
    means = np.mean(found, 0)
    return {"dice": float(means[0]), "iou": float(means[1])} | real_scores(net, real, variant.size)


def real_scores(net: SmallNet, frames: list[RealFrame], size: tuple[int, int]) -> dict[str, float]:
    """Return the mean IoU per group and split ("taxim_sphere tune") of real frames."""
    found: dict[str, list[float]] = {}
    for real in frames:
        one = frame_iou(net, real.image, real.background, real.mask, THRESHOLD, size)
        found.setdefault(f"{real.group} {real.split}", []).append(one)
    return {group: float(np.mean(values)) for group, values in found.items()}


def dice_and_iou(probability: NDArray[np.float32], truth: NDArray[np.bool_]) -> tuple[float, float]:
    """Return Dice and IoU of a probability map of any size against a mask at frame size."""
    mask = np.asarray(cv2.resize(probability, (FRAME_WIDTH_PX, FRAME_HEIGHT_PX)) > THRESHOLD)
    return dice(mask, truth), iou(mask, truth)


def export_network(net: SmallNet, size: tuple[int, int], path: Path) -> Path:
    """Write the network as an ONNX file for images of that (width, height) and return its path."""
    image = torch.zeros((1, size[1], size[0], 3), dtype=torch.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        torch.onnx.export(
            ProbabilityNet(net).eval(),
            (image, image.clone(), torch.ones(1)),
            str(path),
            input_names=["frame", "background", "background_known"],
            output_names=["probability"],
            opset_version=17,
            dynamo=False,
        )
    return path


def export_int8(path: Path, frames: TrainingFrames) -> Path:
    """Write the same network in int8, ranges calibrated on rendered frames, and return its path."""
    out, known = path.with_suffix(".int8.onnx"), np.ones(1, np.float32)
    sample = (
        {"frame": frame[None].copy(), "background": background[None].copy(), "background_known": known}
        for frame, background in zip(frames.frame, frames.background, strict=True)
    )
    write_int8(path, out, sample, CONVOLUTIONS)
    return out


def run_network(network: Any, frame: NDArray[np.uint8], background: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return the probability map (H, W) of one image; only the inputs that the network has are passed."""
    feed = {"frame": frame[None], "background": background[None], "background_known": np.ones(1, np.float32)}
    asked = {port.name for port in network.get_inputs()}
    probability: NDArray[np.float32] = network.run(None, {k: v for k, v in feed.items() if k in asked})[0][0, 0]
    return probability


def score_full_frames(network: Any, shown: TrainingFrames, masks: NDArray[np.uint8]) -> tuple[float, float]:
    """Return the mean Dice and IoU of an ONNX network."""
    pairs = zip(shown.frame, shown.background, masks, strict=True)
    found = [dice_and_iou(run_network(network, f, b), m > 0) for f, b, m in pairs if m.any()]
    return float(np.mean([d for d, _ in found])), float(np.mean([i for _, i in found]))


def score_crops(net: SmallNet, shown: TrainingFrames, masks: NDArray[np.uint8]) -> tuple[float, float, float]:
    """Return mean Dice, mean IoU and the mean crop area as a share of the image, with a crop around the known patch."""
    found, shares = [], []
    for frame, background, small, mask in zip(shown.frame, shown.background, shown.label, masks, strict=True):
        if not mask.any():
            continue
        part = _crop(small > 127)
        probability = np.zeros(small.shape, np.float32)
        probability[part] = probabilities(net, frame[part][None], background[part][None], True)[0].numpy()
        found.append(dice_and_iou(probability, mask > 0))
        shares.append(probability[part].size / probability.size)
    return float(np.mean([d for d, _ in found])), float(np.mean([i for _, i in found])), float(np.mean(shares))


def _crop(mask: NDArray[np.bool_]) -> tuple[slice, slice]:
    """Return the bounding box of a mask with its margin, enlarged to whole steps where the image allows."""
    rows, columns = np.nonzero(mask.any(1))[0], np.nonzero(mask.any(0))[0]
    parts = []
    for low, high, full in (
        (rows.min(), rows.max() + 1, mask.shape[0]),
        (columns.min(), columns.max() + 1, mask.shape[1]),
    ):
        start, stop = max(int(low) - CROP_MARGIN_PX, 0), min(int(high) + CROP_MARGIN_PX, full)
        length = min(-(-(stop - start) // CROP_STEP_PX) * CROP_STEP_PX, full)
        start = min(start, full - length)
        parts.append(slice(start, start + length))
    return parts[0], parts[1]


def median_ms(networks: dict[str, Path], sizes: dict[str, tuple[int, int]]) -> dict[str, float]:
    """Return each network's median processor time; the networks alternate, so other load affects all alike."""
    sessions = {name: open_session(path) for name, path in networks.items()}
    rng = np.random.default_rng(0)
    images = {size: rng.integers(0, 255, (size[1], size[0], 3), np.uint8) for size in set(sizes.values())}
    spent: dict[str, list[float]] = {name: [] for name in networks}
    for _ in range(TIMED_ROUNDS):
        for name, network in sessions.items():
            image = images[sizes[name]]
            start_s = time.thread_time()
            run_network(network, image, image)
            spent[name].append(1e3 * (time.thread_time() - start_s))
    return {name: float(np.median(values)) for name, values in spent.items()}


def compare_variants(
    work: Path, real: Path | None, backgrounds: Path | None, frames: int, epochs: int, seeds: int, bfloat16: bool
) -> None:
    """Train every variant that is not in `work` yet, measure all, print a table in Markdown."""
    console = Console()
    work.mkdir(parents=True, exist_ok=True)
    with console.status("rendering"):
        shown = training_frames(work, frames, lambda _done: None)
        drawn = held_out_frames(work, HELD_OUT_FRAMES, lambda _done: None)
    labelled = [*real_frames(real), *no_contact_frames(real, 4)] if real else []
    labelled = [frame for frame in labelled if frame.split == "tune"]
    unpressed = read_backgrounds(backgrounds) if backgrounds else None
    rows: list[dict[str, Any]] = []
    files: dict[str, Path] = {}
    for variant in VARIANTS:
        found = []
        for seed in range(seeds):
            settings = replace(variant.settings, epochs=epochs, seed=seed, bfloat16=bfloat16)
            folder = work / f"{VARIANTS.index(variant):02d}-{frames}x{epochs}-{seed}"
            folder.mkdir(exist_ok=True)
            kept = folder / "scores.json"
            with console.status(f"{variant.name}, seed {seed}"):
                if not kept.is_file():
                    net = _trained(variant, settings, shown, folder, unpressed)
                    export_network(net, variant.size, folder / "net.onnx")
                    kept.write_text(json.dumps(scores(net, variant, drawn, labelled)))
            found.append(json.loads(kept.read_text()))
            files.setdefault(variant.name, folder / "net.onnx")
        rows.append({"name": variant.name} | {key: float(np.mean([f[key] for f in found])) for key in found[0]})
        console.print(rows[-1])
    base = VARIANTS[0]
    masks = drawn.masks(base.mask)
    held_out = drawn.at(base.size, masks)
    int8_name = "int8, otherwise as shipped"
    calibration = shown.first(CALIBRATION_FRAMES)
    files[int8_name] = export_int8(files[base.name], calibration.at(base.size, calibration.masks(base.mask)))
    overlap = score_full_frames(open_session(files[int8_name]), held_out, masks)
    rows.append({"name": int8_name, "dice": overlap[0], "iou": overlap[1]})
    net = base.net()
    net.load_state_dict(torch.load(files[base.name].parent / "weights.pt", weights_only=True))
    crops = score_crops(net, held_out, masks)
    rows.append(
        {"name": f"crop around the known patch ({crops[2]:.0%} of the image)", "dice": crops[0], "iou": crops[1]}
    )
    side = (round(base.size[0] * crops[2] ** 0.5 / 8) * 8, round(base.size[1] * crops[2] ** 0.5 / 8) * 8)
    files[rows[-1]["name"]] = export_network(net, side, work / "crop.onnx")
    sizes = {variant.name: variant.size for variant in VARIANTS} | {rows[-1]["name"]: side}
    times = median_ms(files, {name: sizes.get(name, base.size) for name in files})
    for row in rows:
        row["time"] = times[row["name"]] / times[base.name]
    console.print(table(rows), soft_wrap=True, markup=False)


def _trained(
    variant: Variant,
    settings: TrainSettings,
    shown: StoredFrames,
    folder: Path,
    unpressed: list[NDArray[np.uint8]] | None,
) -> SmallNet:
    frames = shown.at(variant.size, shown.masks(variant.mask))
    few = TrainingFrames(frames.frame[:50], frames.background[:50], frames.label[:50])

    def nothing(*_: object) -> None:
        return

    return train(frames, few, settings, folder, nothing, nothing, unpressed, make_net=variant.net)


def table(rows: list[dict[str, Any]]) -> str:
    """Return a Markdown table: time relative to the first row, Dice and IoU of held-out presses, IoU of real groups."""
    keys = list(dict.fromkeys(key for row in rows for key in row if key not in ("name", "time")))
    lines = [f"| variant | time | {' | '.join(keys)} |", "|---" * (len(keys) + 2) + "|"]
    for row in rows:
        cells = [f"{row[key]:.3f}" if key in row else "–" for key in keys]
        lines.append(f"| {row['name']} | {row['time']:.2f} | {' | '.join(cells)} |")
    return "\n".join(lines)
