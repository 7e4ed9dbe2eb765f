"""A trained network written as an ONNX file that keeps the model contract, and checked against torch."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import onnxruntime as ort
import torch

from slipguard.errors import ModelError
from slipguard.lab.frame_cache import RenderedFrames
from slipguard.lab.half_storage import round_to_half, store_as_half
from slipguard.lab.networks import Exported, SmallNet, example_inputs
from slipguard.perception.segment import CONTRACT, INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.label import LABEL_NAME

LARGEST_DIFFERENCE = 1e-4
OPSET = 17
CHECKED_FRAMES = 32


def contract_metadata(command: str, seed: int, threshold: float) -> dict[str, str]:
    """What the model contract wants in the file beside the graph."""
    return {
        "slipguard_contract": CONTRACT,
        "threshold": f"{threshold:g}",
        "label": LABEL_NAME,
        "command": command,
        "seed": str(seed),
        "input_size": f"{INPUT_WIDTH_PX}x{INPUT_HEIGHT_PX}",
    }


def export_onnx(net: SmallNet, path: Path, metadata: Mapping[str, str], frames: RenderedFrames) -> float:
    """Write `net` to `path`; return the largest difference of its probabilities to torch's on rendered frames.

    Large weights are rounded to float16 and stored so; what computes is float32, and torch is asked with the rounded.
    Written beside the target first and moved there only when it agrees to 1e-4; otherwise raises `ModelError`
    and leaves the target as it was.
    """
    placed = copy.deepcopy(net)
    round_to_half(placed)
    shipped = Exported(placed).eval()
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft.onnx")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the exporter warns of its own successor
        torch.onnx.export(
            shipped,
            example_inputs(),
            str(draft),
            input_names=["frame", "background", "background_known"],
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
    if not difference <= LARGEST_DIFFERENCE:  # NaN too
        draft.unlink()
        raise ModelError(
            f"{path}: onnxruntime and torch differ by {difference:.2g}, more than {LARGEST_DIFFERENCE:g}; not written"
        )
    draft.replace(path)
    return difference


def _difference(net: Exported, path: Path, frames: RenderedFrames) -> float:
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    largest = 0.0
    for index in range(min(CHECKED_FRAMES, len(frames))):
        feed = {
            "frame": np.array(frames.frame[index : index + 1]),
            "background": np.array(frames.background[index : index + 1]),
            "background_known": np.array([float(index % 2)], np.float32),
        }
        ours = session.run(None, feed)[0]
        with torch.no_grad():
            theirs = net(*(torch.from_numpy(value) for value in feed.values())).numpy()
        largest = max(largest, float(np.abs(ours - theirs).max()))
    return largest
