"""Run time against error on this machine: the shipped network with every estimator, and the paper's pipeline beside it.

All on one core, in one run, on the same rendered grasps of the test objects. Rendered grasps are not the real world:
the errors compare pipelines with each other.
"""

from __future__ import annotations

import platform
import time
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, get_args

import cv2
import numpy as np
import onnxruntime as ort

from slipguard.lab.peer import PEER_MODEL, Peer
from slipguard.lab.scores import dice, iou
from slipguard.lab.sequences import Sequence, Shot, sequence
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segment import Segmenter
from slipguard.perception.settings import EstimatorName, PerceptionSettings
from slipguard.sim.objects import names

QUICK_SEQUENCES, FULL_SEQUENCES = 1, 6
PEER_FRAMES, PEER_WARM_UP_FRAMES = 24, 3
WARM_UP_FRAMES = 40
PEER_NAME = "DeepLabV3+/ResNet18 240×320 + OpenCV thinning"
SEED = 4100


@dataclass(frozen=True, slots=True)
class Row:
    """One pipeline's figures; None where unknown. Times are of frames with contact, but `skipped_p50_ms`: without.

    turn errors: over frames after the reference with an angle; worst object: the largest mean of one object.
    declined_share: of such frames of objects with a readable axis, those without an angle.
    """

    name: str
    network: str
    estimator: str
    p50_ms: float
    p99_ms: float
    skipped_p50_ms: float | None
    turn_error_mean_deg: float | None
    turn_error_worst_object_deg: float | None
    declined_share: float | None
    dice: float | None
    iou: float | None
    frames: int
    sequences: int | None


@dataclass(frozen=True, slots=True)
class Bench:
    """What `slipguard bench` found. errors: pipeline name -> object -> (turn error, sigma) of every compared frame."""

    machine: dict[str, Any]
    pipelines: tuple[Row, ...]
    peers: tuple[Row, ...]
    default: str
    errors: dict[str, dict[str, list[tuple[float, float]]]]

    def as_json(self) -> dict[str, Any]:
        """The public result: machine, pipelines, peers, default."""
        return {
            "machine": self.machine,
            "pipelines": [asdict(row) for row in self.pipelines],
            "peers": [asdict(row) for row in self.peers],
            "default": self.default,
        }


def machine() -> dict[str, Any]:
    """What the figures were taken on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        lines = [line for line in info.read_text(errors="replace").splitlines() if line.startswith("model name")]
        model = lines[0].split(":", 1)[1].strip() if lines else model
    return {
        "processor": model,
        "system": f"{platform.system()} {platform.release()}",
        "python": platform.python_version(),
        "onnxruntime": ort.__version__,
        "opencv": cv2.__version__,
        "threads": 1,
    }


def bench(
    quick: bool, model: Path | None = None, on_progress: Callable[[str, float], None] = lambda _what, _share: None
) -> Bench:
    """Render, measure, time. on_progress(what, share done) is called now and then. Seeds are fixed.

    Sets OpenCV to one thread for the whole process; onnxruntime runs on one anyway.
    """
    cv2.setNumThreads(1)
    segmenter = Segmenter(model)
    per_object = QUICK_SEQUENCES if quick else FULL_SEQUENCES
    wanted = [(name, SEED + k) for k in range(per_object) for name in names("test")]
    estimators: tuple[EstimatorName, ...] = get_args(EstimatorName)
    tallies = [_Tally(segmenter, estimator) for estimator in estimators]
    keep = -(-(PEER_FRAMES + PEER_WARM_UP_FRAMES) // len(wanted))
    kept: list[Shot] = []
    for index, (name, seed) in enumerate(wanted):
        on_progress(f"{name}, grasp {seed - SEED + 1} of {per_object}", 0.9 * index / len(wanted))
        grasp = sequence(name, seed, with_masks=True)
        for tally in tallies:
            tally.add(grasp)
        kept += _spread([shot for shot in grasp.shots if shot.compared], keep)
    on_progress("timing the paper's pipeline", 0.9)
    rows = tuple(tally.row() for tally in tallies)
    default = PerceptionSettings().estimator
    chosen = next(row.name for row in rows if row.estimator == default)
    errors = {row.name: tally.errors for row, tally in zip(rows, tallies, strict=True)}
    return Bench(machine(), rows, (_peer_row(kept),), chosen, errors)


class _Tally:
    """Runs one estimator over grasp after grasp and adds up what it did."""

    def __init__(self, segmenter: Segmenter, estimator: EstimatorName) -> None:
        self._segmenter = segmenter
        self._settings = PerceptionSettings(estimator=estimator)
        self._busy_ms: list[float] = []
        self._empty_ms: list[float] = []
        self._overlaps: list[tuple[float, float]] = []
        self._declined: list[bool] = []
        self._sequences = 0
        self.errors: dict[str, list[tuple[float, float]]] = {}

    def add(self, grasp: Sequence) -> None:
        if self._sequences == 0:
            warm = self._pipeline(grasp)
            for shot in grasp.shots[:WARM_UP_FRAMES]:
                warm.process(shot.frame)
        self._sequences += 1
        pipeline = self._pipeline(grasp)
        for shot in grasp.shots:
            start_s = time.perf_counter()
            seen = pipeline.process(shot.frame)
            spent_ms = 1e3 * (time.perf_counter() - start_s)
            if seen.skipped == "no contact":
                self._empty_ms.append(spent_ms)
            elif seen.skipped is None and seen.contact:
                self._busy_ms.append(spent_ms)
            if shot.contact and shot.mask is not None and seen.skipped is None:
                found, label = pipeline.last_mask > 0, shot.mask > 0
                self._overlaps.append((dice(found, label), iou(found, label)))
            if shot.compared:
                self._compare(grasp, shot, seen)

    def _compare(self, grasp: Sequence, shot: Shot, seen: Estimate) -> None:
        if grasp.readable:
            self._declined.append(seen.angle_deg is None)
        if seen.angle_deg is not None and seen.sigma_deg is not None:
            error = seen.angle_deg - shot.turn_deg
            self.errors.setdefault(grasp.object_name, []).append((error, seen.sigma_deg))

    def _pipeline(self, grasp: Sequence) -> Pipeline:
        return Pipeline(self._segmenter, self._settings, grasp.background, grasp.noise_bgr, grasp.px_per_mm)

    def row(self) -> Row:
        network, estimator = self._segmenter.path.stem, self._settings.estimator
        means = [float(np.mean([abs(error) for error, _ in found])) for found in self.errors.values()]
        everything = [abs(error) for found in self.errors.values() for error, _ in found]
        return Row(
            name=f"{network} + {estimator}",
            network=network,
            estimator=estimator,
            p50_ms=_quantile(self._busy_ms, 0.5),
            p99_ms=_quantile(self._busy_ms, 0.99),
            skipped_p50_ms=_quantile(self._empty_ms, 0.5) if self._empty_ms else None,
            turn_error_mean_deg=round(float(np.mean(everything)), 3) if everything else None,
            turn_error_worst_object_deg=round(max(means), 3) if means else None,
            declined_share=_mean(self._declined),
            dice=_mean([d for d, _ in self._overlaps]),
            iou=_mean([i for _, i in self._overlaps]),
            frames=len(self._busy_ms) + len(self._empty_ms),
            sequences=self._sequences,
        )


def _mean(values: list[float] | list[bool]) -> float | None:
    return round(float(np.mean(values)), 4) if values else None


def _peer_row(shots: list[Shot]) -> Row:
    """Time the paper's two stages on frames in contact; thinning gets the true mask, for the weights are made up."""
    peer = Peer()
    spent_ms = []
    for index, shot in enumerate(shots):
        if shot.mask is None:
            continue
        start_s = time.perf_counter()
        peer.run(shot.frame.image, shot.mask)
        if index >= PEER_WARM_UP_FRAMES:
            spent_ms.append(1e3 * (time.perf_counter() - start_s))
    return Row(
        name=PEER_NAME,
        network=PEER_MODEL.removesuffix(".onnx"),
        estimator="skeleton",
        p50_ms=_quantile(spent_ms, 0.5),
        p99_ms=_quantile(spent_ms, 0.99),
        skipped_p50_ms=None,
        turn_error_mean_deg=None,
        turn_error_worst_object_deg=None,
        declined_share=None,
        dice=None,
        iou=None,
        frames=len(spent_ms),
        sequences=None,
    )


def _spread(shots: list[Shot], count: int) -> list[Shot]:
    picks = np.linspace(0, len(shots) - 1, min(count, len(shots))).astype(int)
    return [shots[index] for index in picks]


def _quantile(values: Iterable[float], share: float) -> float:
    found = list(values)
    return round(float(np.quantile(found, share)), 3) if found else float("nan")
