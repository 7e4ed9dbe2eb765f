"""The paper's networks as ONNX files that keep the model contract, checked against torch before they are in place."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from torch import Tensor, nn

from slipguard.errors import ModelError
from slipguard.lab.half_storage import round_to_half, store_as_half
from slipguard.lab.paper.frames import MaskedFrames
from slipguard.lab.paper.networks import FrameNet
from slipguard.perception.segment import CONTRACT_ANY_INPUT

LARGEST_DIFFERENCE = 1e-4
OPSET = 17
CHECKED_FRAMES = 32


def contract_metadata(
    command: str, seed: int, threshold: float, label: str, size_px: tuple[int, int]
) -> dict[str, str]:
    """What the model contract wants in the file beside the graph. label: what was learnt, in words."""
    return {
        "slipguard_contract": CONTRACT_ANY_INPUT,
        "threshold": f"{threshold:g}",
        "label": label,
        "command": command,
        "seed": str(seed),
        "input_size": f"{size_px[0]}x{size_px[1]}",
    }


class _Shipped(nn.Module):
    """Probabilities in place of logits."""

    def __init__(self, net: FrameNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor) -> Tensor:
        return torch.sigmoid(self.net(frame))


def export_onnx(net: FrameNet, path: Path, metadata: Mapping[str, str], frames: MaskedFrames) -> float:
    """Write `net` to `path`; return the largest difference of onnxruntime's probabilities to torch's.

    The weights of the convolutions are rounded to float16 and stored so; what computes is float32 still, and torch is
    asked with the rounded weights. frames: what the check is made on, of the network's size. Written beside the target
    and moved there only when both agree to 1e-4; otherwise raises `ModelError` and leaves the target alone.
    """
    placed: Any = copy.deepcopy(net).to("cpu")
    placed.to(memory_format=torch.contiguous_format)
    round_to_half(placed)
    shipped = _Shipped(placed).eval()
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft.onnx")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter warns of its own successor
            torch.onnx.export(
                shipped,
                (torch.from_numpy(np.array(frames.frame[:1])),),
                str(draft),
                input_names=["frame"],
                output_names=["probability"],
                opset_version=OPSET,
                training=torch.onnx.TrainingMode.PRESERVE,  # or weights are multiplied out and no float16 any more
                dynamo=False,
            )
        model = onnx.load(str(draft))
        store_as_half(model)
        for key, value in metadata.items():
            model.metadata_props.add(key=key, value=value)
        onnx.checker.check_model(model)
        onnx.save(model, str(draft))
        difference = _difference(shipped, draft, frames)
        if not difference <= LARGEST_DIFFERENCE:
            raise ModelError(
                f"{path}: onnxruntime and torch differ by {difference:.2g}, over {LARGEST_DIFFERENCE:g}; not written"
            )
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return difference


def session(path: Path, threads: int = 1) -> Any:
    """The network of an exported file, to run on the CPU."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _difference(net: _Shipped, path: Path, frames: MaskedFrames) -> float:
    running = session(path)
    largest = 0.0
    for index in range(min(CHECKED_FRAMES, len(frames))):
        frame = np.array(frames.frame[index : index + 1])
        with torch.no_grad():
            theirs = net(torch.from_numpy(frame)).numpy()
        largest = max(largest, float(np.abs(running.run(None, {"frame": frame})[0] - theirs).max()))
    return largest
