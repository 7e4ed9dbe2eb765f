"""Pipelines to compare: networks, estimators and skipping combined; a new instance for each grasp."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal, Protocol, get_args

import numpy as np
from numpy.typing import NDArray

from slipguard.bench.comparison_pipelines import BackgroundSubtraction, FrameNetwork, PaperPipeline
from slipguard.bench.segmentation_cache import CLOCK, CachedSegmenter
from slipguard.datasets.rendered_grasps import RenderedGrasp
from slipguard.devices import Frame
from slipguard.errors import ModelError
from slipguard.perception.contact.segmenter import Segmenter, default_model_path
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import EstimatorName, PerceptionSettings
from slipguard.perception.skipping import ALL_SKIPS, Skips

ESTIMATORS: tuple[EstimatorName, ...] = get_args(EstimatorName)
NO_SKIP = Skips(no_contact=False, unchanged=False, round=False)
PEER_MODEL = "peer-deeplabv3plus-resnet18-timing.onnx"
Kind = Literal["ours", "paper", "subtraction"]


class FrameProcessor(Protocol):
    """Frame after frame of one grasp."""

    def process(self, frame: Frame) -> Estimate: ...

    @property
    def last_mask(self) -> NDArray[np.uint8]: ...


@dataclass(frozen=True, slots=True)
class BenchPipeline:
    """One pipeline to be benched; picklable. path: of its network, None without one. sees: `contract` or `frame`."""

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
        """Unique within a bench."""
        if self.kind == "paper":
            cores = "" if self.threads == 1 else f", {self.threads} threads"
            return f"the paper's pipeline: {self.network} {self.resolution} + OpenCV thinning + line{cores}"
        plain = f"{self.network} + {self.estimator}"
        return plain if self.skips == ALL_SKIPS or self.kind == "subtraction" else f"{plain}, no skipping"

    def forget(self, share: bool = False) -> None:
        """What the network said is forgotten. share: from now on it is kept for all who ask about the same frames."""
        if self.kind == "subtraction":
            return
        if self.sees == "contract":
            _remembered(self.path).memory.forget(share)
        else:
            _frame_network(self.path, self.threads).memory.forget(share)

    @property
    def large(self) -> bool:
        """Tens of milliseconds a frame or more."""
        return self.sees == "frame"

    @property
    def made_up(self) -> bool:
        """The network's weights mean nothing: only times can be told."""
        return self.sees == "frame" and _frame_network(self.path, self.threads).made_up

    def open(self, grasp: RenderedGrasp, masks: dict[int, NDArray[np.uint8]] | None = None) -> FrameProcessor:
        """Ready for the frames of a grasp. masks: what takes the place of a made-up network's answer."""
        if self.kind == "subtraction":
            return BackgroundSubtraction(grasp.background, "ellipse" if self.estimator == "ellipse" else "pca")
        if self.kind == "paper":
            network = _frame_network(self.path, self.threads)
            return PaperPipeline(network, masks if network.made_up else None)
        segmenter = _remembered(self.path) if self.sees == "contract" else _frame_network(self.path, self.threads)
        return Pipeline(
            segmenter,
            PerceptionSettings.model_validate({"estimator": self.estimator}),
            grasp.background,
            grasp.noise_bgr,
            grasp.px_per_mm,
            timer=CLOCK,
            skips=self.skips,
        )


@lru_cache(maxsize=8)
def _contract(path: Path | None) -> Segmenter:
    return Segmenter(path)


@lru_cache(maxsize=8)
def _remembered(path: Path | None) -> CachedSegmenter:
    return CachedSegmenter(_contract(path))


@lru_cache(maxsize=8)
def _frame_network(path: Path | None, threads: int) -> FrameNetwork:
    return FrameNetwork(default_model_path().with_name(PEER_MODEL) if path is None else path, threads)


def ours(path: Path | None, every: bool) -> list[BenchPipeline]:
    """A network that keeps the model contract with every estimator; where `every`, also without skipping."""
    segmenter = _contract(path)
    width, height = segmenter.input_size
    stem, size = segmenter.path.stem, f"{width}×{height}"
    default = PerceptionSettings().estimator
    found = [BenchPipeline("ours", stem, name, segmenter.path, "contract", size) for name in ESTIMATORS]
    plain = ESTIMATORS if every else (default,)
    return found + [BenchPipeline("ours", stem, name, segmenter.path, "contract", size, NO_SKIP) for name in plain]


def large(path: Path, threads: int = 1) -> list[BenchPipeline]:
    """A frame network with the paper's way to the turn, then with slipguard's estimators."""
    network = _frame_network(path, threads)
    size = f"{network.width}×{network.height}"
    theirs = BenchPipeline("paper", path.stem, "skeleton", path, "frame", size, NO_SKIP, threads)
    if network.made_up:
        return [theirs]
    return [theirs, *(BenchPipeline("ours", path.stem, name, path, "frame", size) for name in ESTIMATORS)]


def without_network() -> list[BenchPipeline]:
    """Background subtraction."""
    return [
        BenchPipeline("subtraction", "background subtraction", axis, None, "contract", "240×320", NO_SKIP)
        for axis in ("pca", "ellipse")
    ]


def network_files(folder: Path | None) -> tuple[list[Path], list[Path]]:
    """Networks in a folder: those that keep the model contract (the shipped one aside), and frame networks.

    Raises `ModelError` for a file that is neither, or a folder without any.
    """
    if folder is None:
        return [], []
    if not folder.is_dir():
        raise ModelError(f"--models {folder}: no such folder; name one with .onnx files")
    paths = sorted(folder.glob("*.onnx"))
    if not paths:
        raise ModelError(f"--models {folder}: no .onnx file in it")
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
