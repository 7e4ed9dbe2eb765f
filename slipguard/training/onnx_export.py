"""Export of networks as ONNX files that fulfill the model contract: float16 weights, and a check against torch."""

from __future__ import annotations

import copy
import warnings
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

from slipguard.errors import ModelError
from slipguard.perception.segmenter import CONTRACT, CONTRACT_ANY_INPUT, INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.contact_label import LABEL_NAME
from slipguard.training.augment import TrainingFrames
from slipguard.training.small_network import ProbabilityNet, SmallNet, example_inputs

DIFFERENCE_MAX = 1e-4
"""Largest difference between the probabilities of onnxruntime and torch."""
OPSET = 17
CHECKED_FRAMES = 32
"""Frames on which both are compared."""
FLOAT16_FROM = 1024
"""Arrays of at least this many weights are stored as float16: the convolutions, which make up the size."""
INPUTS = ("frame", "background", "background_known")

Feed = dict[str, NDArray[Any]]
"""Inputs of the graph by name."""


def model_metadata(
    command: str, seed: int, threshold: float, label: str = LABEL_NAME, size_px: tuple[int, int] | None = None
) -> dict[str, str]:
    """Return the metadata of the model contract.

    Args:
        command: The command that makes the network.
        seed: Its seed.
        threshold: Probability above which a pixel is contact.
        label: What the masks mean, in words.
        size_px: (width, height) of the input of a network that sees the frame only; None for the small network.
    """
    width, height = size_px or (INPUT_WIDTH_PX, INPUT_HEIGHT_PX)
    return {
        "slipguard_contract": CONTRACT if size_px is None else CONTRACT_ANY_INPUT,
        "threshold": f"{threshold:g}",
        "label": label,
        "command": command,
        "seed": str(seed),
        "input_size": f"{width}x{height}",
    }


def export_small(net: SmallNet, path: Path, metadata: Mapping[str, str], frames: TrainingFrames) -> float:
    """Write the small network to `path`; return the largest difference of its probabilities to torch's.

    Raises:
        ModelError: As `write_checked`.
    """
    rounded = copy.deepcopy(net)
    round_to_float16(rounded)
    example = dict(zip(INPUTS, (one.numpy() for one in example_inputs()), strict=True))
    return write_checked(ProbabilityNet(rounded).eval(), example, path, metadata, _small_feeds(frames))


def write_checked(
    net: nn.Module, example: Feed, path: Path, metadata: Mapping[str, str], feeds: Iterable[Feed]
) -> float:
    """Write a network to `path`; return the largest difference of onnxruntime's output to torch's over `feeds`.

    The file is written next to the target and moved there only if both agree.

    Args:
        net: Returns probabilities. Its large weights must be rounded to float16, in which they are stored.
        example: One input, in the order of the network's arguments.
        path: The target.
        metadata: Key-value pairs of the model contract.
        feeds: Inputs for the comparison.

    Raises:
        ModelError: The outputs differ by more than `DIFFERENCE_MAX`; the target is left as it was.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".draft.onnx")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the exporter announces its successor
            torch.onnx.export(
                net,
                tuple(torch.from_numpy(value) for value in example.values()),
                str(draft),
                input_names=list(example),
                output_names=["probability"],
                opset_version=OPSET,
                training=torch.onnx.TrainingMode.PRESERVE,  # folded weights would not be float16 any more
                dynamo=False,
            )
        model = onnx.load(str(draft))
        _store_as_float16(model)
        for key, value in metadata.items():
            model.metadata_props.add(key=key, value=value)
        onnx.checker.check_model(model)
        onnx.save(model, str(draft))
        difference = _difference(net, draft, feeds)
        if not difference <= DIFFERENCE_MAX:  # also true of NaN
            raise ModelError(
                f"{path}: not written; onnxruntime and torch differ by {difference:.2g}, limit {DIFFERENCE_MAX:g}. "
                "Check the network for weights that are not finite."
            )
        draft.replace(path)
    finally:
        draft.unlink(missing_ok=True)
    return difference


def open_session(path: Path) -> Any:
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = 1
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


def _small_feeds(frames: TrainingFrames) -> Iterator[Feed]:
    """Yield inputs, every other one without a known background image."""
    for index in range(min(CHECKED_FRAMES, len(frames))):
        frame, background = (np.array(some[index : index + 1]) for some in (frames.frame, frames.background))
        yield dict(zip(INPUTS, (frame, background, np.array([float(index % 2)], np.float32)), strict=True))


def round_to_float16(net: nn.Module) -> None:
    """Round the large weights to float16, so that storing them loses nothing; computation stays float32."""
    with torch.no_grad():
        for weights in net.parameters():
            if weights.numel() >= FLOAT16_FROM:
                weights.copy_(weights.half().float())


def _store_as_float16(model: Any) -> None:
    """Replace float32 weights that float16 holds exactly by float16 and a cast, which runs once per session."""
    casts = []
    for weights in model.graph.initializer:
        values: NDArray[Any] = numpy_helper.to_array(weights)
        halves = values.astype(np.float16)
        if weights.data_type != TensorProto.FLOAT or values.size < FLOAT16_FROM or not np.array_equal(values, halves):
            continue
        name = weights.name
        weights.CopyFrom(numpy_helper.from_array(halves, f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    for cast in reversed(casts):
        model.graph.node.insert(0, cast)


def _difference(net: nn.Module, path: Path, feeds: Iterable[Feed]) -> float:
    """Return the largest difference; NaN if either output contains NaN."""
    session = open_session(path)
    largest = [0.0]
    for feed in feeds:
        ours = session.run(None, feed)[0]
        with torch.no_grad():
            theirs = net(*(torch.from_numpy(value) for value in feed.values())).numpy()
        largest.append(float(np.abs(ours - theirs).max()))
    return float(np.max(largest))
