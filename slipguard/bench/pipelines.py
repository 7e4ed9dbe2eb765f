"""Pipelines to compare: networks, estimators and skipping combined; a new instance for each grasp."""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from slipguard.bench.comparison_pipelines import BackgroundSubtraction, FrameNetwork, PaperPipeline
from slipguard.datasets.rendered_grasps import RenderedGrasp
from slipguard.devices import Frame
from slipguard.errors import ModelError
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter, default_model_path
from slipguard.perception.settings import EstimatorName, PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips

ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)
NO_SKIP = Skips(no_contact=False, unchanged=False, whole=False)
PEER_MODEL = "peer-deeplabv3plus-resnet18-timing.onnx"
Kind = Literal["ours", "paper", "subtraction"]


class FrameProcessor(Protocol):
    """Processes the frames of one grasp in order."""

    def process(self, frame: Frame) -> Estimate: ...

    @property
    def last_mask(self) -> NDArray[np.uint8]: ...


@dataclass(frozen=True, slots=True)
class BenchPipeline:
    """One pipeline to measure; picklable.

    Attributes:
        path: The network's file; None without a network.
        sees: Input of the network: "contract" for frame and background image, "frame" for the frame only.
    """

    kind: Kind
    network: str
    estimator: str
    path: Path | None = None
    sees: Literal["contract", "frame"] = "contract"
    resolution: str | None = None
    skips: Skips = ALL_SKIPS
    threads: int = 1

    @property
    def name(self) -> str:
        """The name, unique within a bench."""
        if self.kind == "paper":
            cores = "" if self.threads == 1 else f", {self.threads} threads"
            return f"the paper's pipeline: {self.network} {self.resolution} + OpenCV thinning + line{cores}"
        plain = f"{self.network} + {self.estimator}"
        return plain if self.skips == ALL_SKIPS or self.kind == "subtraction" else f"{plain}, no skipping"

    @property
    def large(self) -> bool:
        """Whether a frame takes tens of milliseconds or more."""
        return self.sees == "frame"

    @property
    def timing_only(self) -> bool:
        """Whether the network has arbitrary weights, so that only its time has a meaning."""
        return self.sees == "frame" and _frame_network(self.path, self.threads).timing_only

    def open(self, grasp: RenderedGrasp, masks: dict[int, NDArray[np.uint8]] | None = None) -> FrameProcessor:
        """Return a new instance for the frames of a grasp.

        masks: by frame number, used instead of the output of a network with arbitrary weights.
        """
        if self.kind == "subtraction":
            return BackgroundSubtraction(grasp.background, "ellipse" if self.estimator == "ellipse" else "pca")
        if self.kind == "paper":
            network = _frame_network(self.path, self.threads)
            return PaperPipeline(network, masks if network.timing_only else None)
        segmenter = _segmenter(self.path) if self.sees == "contract" else _frame_network(self.path, self.threads)
        return Pipeline(
            segmenter,
            PerceptionSettings.model_validate({"estimator": self.estimator}),
            grasp.background,
            grasp.noise_bgr,
            grasp.px_per_mm,
            timer=time.perf_counter,
            skips=self.skips,
        )


@lru_cache(maxsize=8)
def _segmenter(path: Path | None) -> Segmenter:
    return Segmenter(path)


@lru_cache(maxsize=8)
def _frame_network(path: Path | None, threads: int) -> FrameNetwork:
    return FrameNetwork(default_model_path().with_name(PEER_MODEL) if path is None else path, threads)


def with_small_network(path: Path | None, all_without_skipping: bool) -> list[BenchPipeline]:
    """Return pipelines with every estimator for a network that keeps the model contract.

    The default estimator is also measured without skipping; all estimators if `all_without_skipping`.
    """
    segmenter = _segmenter(path)
    width, height = segmenter.input_size
    stem, size = segmenter.path.stem, f"{width}×{height}"
    default = PerceptionSettings().estimator
    found = [BenchPipeline("ours", stem, name, segmenter.path, "contract", size) for name in ESTIMATORS]
    plain = ESTIMATORS if all_without_skipping else (default,)
    return found + [BenchPipeline("ours", stem, name, segmenter.path, "contract", size, NO_SKIP) for name in plain]


def with_large_network(path: Path, threads: int = 1) -> list[BenchPipeline]:
    """Return the paper's pipeline with a frame network, then slipguard's estimators with it."""
    network = _frame_network(path, threads)
    size = f"{network.width}×{network.height}"
    paper = BenchPipeline("paper", path.stem, "skeleton", path, "frame", size, NO_SKIP, threads)
    if network.timing_only:
        return [paper]
    return [paper, *(BenchPipeline("ours", path.stem, name, path, "frame", size) for name in ESTIMATORS)]


def with_timing_network() -> list[BenchPipeline]:
    """Return the paper's pipeline with a network that has the layers of the paper's and arbitrary weights."""
    return with_large_network(default_model_path().with_name(PEER_MODEL))


def without_network() -> list[BenchPipeline]:
    """Return the pipelines that segment by background subtraction."""
    return [
        BenchPipeline("subtraction", "background subtraction", axis, None, "contract", "240×320", NO_SKIP)
        for axis in ("pca", "ellipse")
    ]


def network_files(folder: Path | None) -> tuple[list[Path], list[Path]]:
    """Return the networks of a folder except the shipped ones: those that keep the model contract, and frame networks.

    Raises:
        ModelError: If a file is neither, or the folder has no networks.
    """
    if folder is None:
        return [], []
    if not folder.is_dir():
        raise ModelError(f"--models {folder}: no such folder. Name a folder with .onnx files")
    paths = sorted(folder.glob("*.onnx"))
    if not paths:
        raise ModelError(f"--models {folder}: no .onnx file in it. Name a folder with .onnx files")
    contract, frame = [], []
    for path in paths:
        if path.name == PEER_MODEL or path.resolve() == default_model_path().resolve():
            continue
        try:
            FrameNetwork(path)
            frame.append(path)
        except ModelError:
            Segmenter(path)
            contract.append(path)
    return contract, frame
