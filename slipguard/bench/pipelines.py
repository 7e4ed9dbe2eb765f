"""Pipelines to compare: networks, estimators and skipping combined; a new instance for each grasp."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, get_args

from slipguard.bench.comparison_pipelines import (
    BackgroundSubtraction,
    FrameNetwork,
    FrameProcessor,
    PaperPipeline,
    SkeletonAxis,
    ZeroRotation,
)
from slipguard.datasets.rendered_grasps import RenderedGrasp
from slipguard.errors import ModelError
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter, default_model_path
from slipguard.perception.settings import EstimatorName, PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips

ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)
NO_SKIP = Skips(no_contact=False, unchanged=False, whole=False)
PEER_MODEL = "peer-deeplabv3plus-resnet18-timing.onnx"
Kind = Literal["ours", "paper", "subtraction", "paper axis", "zero"]


@dataclass(frozen=True, slots=True)
class BenchPipeline:
    """One pipeline to measure; picklable.

    Attributes:
        path: The network's file; None without a network.
        sees: Input of the network: "contract" for frame and background image, "frame" for the frame only.
    """

    kind: Kind
    network: str = ""
    estimator: str = ""
    path: Path | None = None
    sees: Literal["contract", "frame"] = "contract"
    resolution: str | None = None
    skips: Skips = ALL_SKIPS
    threads: int = 1

    @property
    def name(self) -> str:
        """The name, unique within a bench."""
        if self.kind in ("zero", "paper axis"):
            return self.kind
        if self.kind == "paper":
            cores = "" if self.threads == 1 else f", {self.threads} threads"
            return f"the paper's pipeline: {self.network} {self.resolution} + OpenCV thinning + line{cores}"
        plain = f"{self.network} + {self.estimator}"
        if self.kind == "subtraction" or self.skips == ALL_SKIPS:
            return plain
        off = ("no_contact", "unchanged", "whole")
        missing = [name for name in off if not getattr(self.skips, name)]
        return f"{plain}, no skipping" + ("" if self.skips == NO_SKIP else f" of {', '.join(missing)}")

    @property
    def timing_only(self) -> bool:
        """Whether the network has arbitrary weights, so that only its time has a meaning."""
        return self.sees == "frame" and _frame_network(self.path, self.threads).timing_only

    def open(self, grasp: RenderedGrasp) -> FrameProcessor:
        """Return a new instance for the frames of a grasp.

        A network with arbitrary weights is followed by the labels of the grasp, where a frame has one.
        """
        if self.kind == "zero":
            return ZeroRotation()
        if self.kind == "subtraction":
            return BackgroundSubtraction(grasp.background)
        if self.kind == "paper":
            network = _frame_network(self.path, self.threads)
            masks = {shot.frame.sequence: shot.mask for shot in grasp.shots if shot.mask is not None}
            return PaperPipeline(network, masks if network.timing_only else None)
        segmenter = _segmenter(self.path) if self.sees == "contract" else _frame_network(self.path, self.threads)
        settings = PerceptionSettings.model_validate({"estimator": self.estimator})
        pipeline = Pipeline(
            segmenter, settings, grasp.background, grasp.noise_bgr, grasp.px_per_mm, timer=time.perf_counter,
            skips=self.skips,
        )  # fmt: skip
        return SkeletonAxis(pipeline) if self.kind == "paper axis" else pipeline


@lru_cache(maxsize=8)
def _segmenter(path: Path | None) -> Segmenter:
    return Segmenter(path)


@lru_cache(maxsize=8)
def _frame_network(path: Path | None, threads: int) -> FrameNetwork:
    return FrameNetwork(default_model_path().with_name(PEER_MODEL) if path is None else path, threads)


def with_small_network(path: Path | None, all_without_skipping: bool = False) -> list[BenchPipeline]:
    """Return pipelines with every estimator for a network that keeps the model contract, the default estimator first.

    The default estimator is also measured without skipping; all estimators if `all_without_skipping`.
    """
    segmenter = _segmenter(path)
    width, height = segmenter.input_size
    stem, size = segmenter.path.stem, f"{width}×{height}"
    default = PerceptionSettings().estimator
    names = sorted(ESTIMATORS, key=lambda name: name != default)
    found = [BenchPipeline("ours", stem, name, segmenter.path, "contract", size) for name in names]
    plain = names if all_without_skipping else [default]
    return found + [BenchPipeline("ours", stem, name, segmenter.path, "contract", size, NO_SKIP) for name in plain]


def with_large_network(path: Path) -> list[BenchPipeline]:
    """Return the paper's pipeline with a frame network, on one thread and on all, then slipguard's with it."""
    network = _frame_network(path, 1)
    size = f"{network.width}×{network.height}"
    papers = [
        BenchPipeline("paper", path.stem, "skeleton", path, "frame", size, NO_SKIP, threads)
        for threads in sorted({1, os.cpu_count() or 1})
    ]
    if network.timing_only:
        return papers
    return [*papers, *(BenchPipeline("ours", path.stem, name, path, "frame", size) for name in ESTIMATORS)]


def with_timing_network() -> list[BenchPipeline]:
    """Return the paper's pipeline with a network that has the layers of the paper's and arbitrary weights."""
    return with_large_network(default_model_path().with_name(PEER_MODEL))


def without_network() -> BenchPipeline:
    """Return the pipeline that segments by background subtraction."""
    return BenchPipeline("subtraction", "background subtraction", "pca", None, "contract", "240×320", NO_SKIP)


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
