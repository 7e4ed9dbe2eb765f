"""The network run on a crop around the patch found last, to see whether that pays. slipguard does not do it.

The same weights at smaller input sizes: the graph's fixed sizes are rewritten. What the network takes from the whole
picture (the level of the light, the deepest press) it then takes from the crop: that is the error added.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from slipguard.bench.error_tally import PipelineResults
from slipguard.bench.pipelines import BenchPipeline
from slipguard.bench.rows import SkipResult, mean
from slipguard.datasets.rendered_grasps import RenderedGrasp, render_grasp
from slipguard.errors import ModelError
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object, object_names

SEED = 4100
SIZES = ((64, 64), (80, 80), (96, 96), (96, 128), (112, 144))
"""Widths and heights that the strides divide, network pixels."""
MARGIN_PX = 12
"""Around the patch: what the network must see of the gel beside it, and room for a fast turn."""
WHOLE_EVERY = 15
"""Every so many-th frame is seen whole: a second contact may have come."""


class CroppedSegmenter:
    """Segments the neighbourhood of what it found last; the whole picture at first, now and then, and where that is
    hardly larger. Raises `ModelError` where the network cannot be cut, or `onnx` is not installed.
    """

    def __init__(self, whole: Segmenter) -> None:
        self._whole = whole
        self.threshold, self.input_size = whole.threshold, whole.input_size
        self._sessions = {size: _session(whole.path, size) for size in SIZES}
        self._box: tuple[int, int, int, int] | None = None
        self._count = 0
        self._background: NDArray[np.uint8] | None = None
        self._small = np.zeros(0, np.uint8)

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        """As `Segmenter.segment`; 0 outside the crop."""
        self._count += 1
        window = None if self._count % WHOLE_EVERY == 0 or background is None else self._window()
        if window is None or background is None:
            answer = self._whole.segment(image, background)
        else:
            left, top, width, height = window
            if background is not self._background:
                self._background, self._small = background, _halved(background)
            part = np.ascontiguousarray(_halved(image)[top : top + height, left : left + width])
            beside = np.ascontiguousarray(self._small[top : top + height, left : left + width])
            feed = {"frame": part[None], "background": beside[None], "background_known": np.ones(1, np.float32)}
            answer = np.zeros((self.input_size[1], self.input_size[0]), np.float32)
            found = self._sessions[width, height].run(["probability"], feed)[0][0, 0]
            answer[top : top + height, left : left + width] = np.clip(found, 0.0, 1.0)
        y, x = np.nonzero(answer > self.threshold)
        self._box = (int(x.min()), int(y.min()), int(x.max()) + 1, int(y.max()) + 1) if x.size else None
        return answer

    def _window(self) -> tuple[int, int, int, int] | None:
        """Left, top, width, height of the smallest crop with room for the patch; None: look at the whole."""
        if self._box is None:
            return None
        left, top, right, bottom = self._box
        full_w, full_h = self.input_size
        left, top = max(left - MARGIN_PX, 0), max(top - MARGIN_PX, 0)
        right, bottom = min(right + MARGIN_PX, full_w), min(bottom + MARGIN_PX, full_h)
        for width, height in SIZES:
            if width >= right - left and height >= bottom - top:
                return min(left, full_w - width), min(top, full_h - height), width, height
        return None


def known_patch(default: BenchPipeline) -> SkipResult | None:
    """What the crop would be worth, over one grasp of each readable test object; None where it cannot be tried."""
    whole = Segmenter(default.path)
    try:
        cropped = CroppedSegmenter(whole)
    except ModelError:
        return None
    tallies = {"whole": PipelineResults(), "cropped": PipelineResults()}
    for name in (name for name in object_names("test") if find_object(name).axial):
        grasp = render_grasp(name, SEED, with_masks=True, mask_every=4)
        opened = {
            "whole": _pipeline(whole, grasp, default.estimator),
            "cropped": _pipeline(cropped, grasp, default.estimator),
        }
        into = {key: results.begin(grasp) for key, results in tallies.items()}
        for shot in grasp.shots:  # in turn, so that a busy machine slows both alike
            for key, pipeline in opened.items():
                tallies[key].take(pipeline, shot, into[key])
    spent = {key: float(np.median(results.busy_ms)) for key, results in tallies.items()}
    errors = {
        key: mean(e for one in results.grasps for e, _, _ in one.found) or 0.0 for key, results in tallies.items()
    }
    overlap = {key: mean(d for d, _ in results.overlaps) or 0.0 for key, results in tallies.items()}
    how = (
        f"{len(tallies['whole'].busy_ms)} frames in contact, whole and cropped: error {errors['whole']:.3f}° and "
        f"{errors['cropped']:.3f}°, Dice {overlap['whole']:.3f} and {overlap['cropped']:.3f}"
    )
    error_added = errors["cropped"] - errors["whole"]
    return SkipResult(
        "known patch: only its crop", False, spent["whole"] - spent["cropped"], None, error_added, None, how
    )


def _pipeline(segmenter: Segmenter | CroppedSegmenter, grasp: RenderedGrasp, estimator: str) -> Pipeline:
    settings = PerceptionSettings.model_validate({"estimator": estimator})
    return Pipeline(segmenter, settings, grasp.background, grasp.noise_bgr, grasp.px_per_mm)


def _halved(image: NDArray[np.uint8]) -> NDArray[np.uint8]:
    size = (image.shape[1] // 2, image.shape[0] // 2)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)


def _session(path: Path, size: tuple[int, int]) -> Any:
    """The network of a file at another input size (width, height)."""
    try:
        onnx: Any = importlib.import_module("onnx")
    except ImportError as error:
        raise ModelError("a network can be cut only with the package onnx (slipguard[train])") from error
    model = onnx.load(str(path))
    del model.graph.value_info[:]
    for port in model.graph.input:
        sides = port.type.tensor_type.shape.dim
        if len(sides) == 4:
            sides[1].dim_value, sides[2].dim_value = size[1], size[0]
    sides = model.graph.output[0].type.tensor_type.shape.dim
    sides[2].dim_value, sides[3].dim_value = size[1], size[0]
    options = ort.SessionOptions()
    options.intra_op_num_threads = options.inter_op_num_threads = 1
    options.log_severity_level = 4
    picture = np.full((1, size[1], size[0], 3), 96, np.uint8)
    try:
        session = ort.InferenceSession(model.SerializeToString(), options, providers=["CPUExecutionProvider"])
        session.run(None, {"frame": picture, "background": picture, "background_known": np.ones(1, np.float32)})
    except Exception as error:
        raise ModelError(f"{path}: cannot be run at {size[0]}×{size[1]}") from error
    return session
