"""A torch module written as an ONNX file with its metadata, and compared with torch before it is put in place."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from torch import nn

from slipguard.errors import ModelError
from slipguard.training.float16_weights import store_as_half

LARGEST_DIFFERENCE = 1e-4
OPSET = 17
CHECKED_FRAMES = 32
"""How many frames a comparison is made on."""
Feed = dict[str, NDArray[Any]]
"""Inputs of the graph by name."""


def file_metadata(
    contract: str, command: str, seed: int, threshold: float, label: str, size_px: tuple[int, int]
) -> dict[str, str]:
    """What a model contract wants in the file beside the graph. label: what was learnt. size_px: width and height."""
    return {
        "slipguard_contract": contract,
        "threshold": f"{threshold:g}",
        "label": label,
        "command": command,
        "seed": str(seed),
        "input_size": f"{size_px[0]}x{size_px[1]}",
    }


def write_compared(
    shipped: nn.Module, example: Feed, path: Path, facts: Mapping[str, str], feeds: Iterable[Feed]
) -> float:
    """Write `shipped` to `path`; return the largest difference of onnxruntime's output to torch's over `feeds`.

    Large weights are stored as float16: round them first. example: one input, in the order of `shipped`'s arguments;
    the output is called "probability". Written beside the target, and moved there only when both agree to 1e-4;
    otherwise raises `ModelError` and leaves the target as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft.onnx")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter warns of its own successor
            torch.onnx.export(
                shipped,
                tuple(torch.from_numpy(value) for value in example.values()),
                str(draft),
                input_names=list(example),
                output_names=["probability"],
                opset_version=OPSET,
                training=torch.onnx.TrainingMode.PRESERVE,  # or weights are multiplied out and no float16 any more
                dynamo=False,
            )
        model = onnx.load(str(draft))
        store_as_half(model)
        for key, value in facts.items():
            model.metadata_props.add(key=key, value=value)
        onnx.checker.check_model(model)
        onnx.save(model, str(draft))
        difference = _difference(shipped, draft, feeds)
        if not difference <= LARGEST_DIFFERENCE:  # NaN too
            raise ModelError(
                f"{path}: onnxruntime and torch differ by {difference:.2g}, over {LARGEST_DIFFERENCE:g}; not written"
            )
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return difference


def session(path: Path, threads: int = 1) -> Any:
    """The network of a file, to run on the CPU."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _difference(shipped: nn.Module, path: Path, feeds: Iterable[Feed]) -> float:
    """NaN where either says NaN anywhere."""
    running = session(path)
    largest = [0.0]
    for feed in feeds:
        ours = running.run(None, feed)[0]
        with torch.no_grad():
            theirs = shipped(*(torch.from_numpy(value) for value in feed.values())).numpy()
        largest.append(float(np.abs(ours - theirs).max()))
    return float(np.max(largest))
