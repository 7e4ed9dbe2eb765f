"""Export of networks as ONNX files that fulfill the model contract: float16 weights, a check against torch, int8."""

from __future__ import annotations

import copy
import logging
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import onnxruntime as ort
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import Tensor, nn

from slipguard.datasets.frame_cache import RenderedFrames
from slipguard.errors import ModelError
from slipguard.perception.contact.segmenter import CONTRACT, CONTRACT_ANY_INPUT, INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.contact_label import LABEL_NAME
from slipguard.training.paper.frames import MaskedFrames
from slipguard.training.paper.networks import FrameNet
from slipguard.training.small_network import ProbabilityNet, SmallNet, example_inputs

DIFFERENCE_MAX = 1e-4
"""Largest difference between the probabilities of onnxruntime and torch."""
OPSET = 17
CHECKED_FRAMES = 32
"""Frames on which both are compared."""
FLOAT16_FROM = 1024
"""Arrays of at least this many weights are stored as float16: the convolutions, which make up the size."""
CALIBRATION_FRAMES = 64
"""Frames that define the range of int8 activations."""
CONVOLUTIONS = ("Conv",)
QUANTIZED_OPERATORS = (*CONVOLUTIONS, "Relu", "MaxPool", "Add")
INPUTS = ("frame", "background", "background_known")
SMALL_SIZE_PX = (INPUT_WIDTH_PX, INPUT_HEIGHT_PX)

Feed = dict[str, NDArray[Any]]
"""Inputs of the graph by name."""


def small_metadata(command: str, seed: int, threshold: float) -> dict[str, str]:
    """Return the metadata of the model contract for the small network."""
    return _metadata(CONTRACT, command, seed, threshold, LABEL_NAME, SMALL_SIZE_PX)


def paper_metadata(command: str, seed: int, threshold: float, label: str, size_px: tuple[int, int]) -> dict[str, str]:
    """Return the metadata of the model contract for one of the paper's networks.

    Args:
        command: The command that makes the network.
        seed: Its seed.
        threshold: Probability above which a pixel is contact.
        label: What the masks mean, in words.
        size_px: (width, height) of the input.
    """
    return _metadata(CONTRACT_ANY_INPUT, command, seed, threshold, label, size_px)


def export_small(net: SmallNet, path: Path, metadata: Mapping[str, str], frames: RenderedFrames) -> float:
    """Write the small network to `path`; return the largest difference of its probabilities to torch's.

    Raises:
        ModelError: As `write_checked`.
    """
    rounded = copy.deepcopy(net)
    _round_to_float16(rounded)
    example = dict(zip(INPUTS, (one.numpy() for one in example_inputs()), strict=True))
    return write_checked(ProbabilityNet(rounded).eval(), example, path, metadata, _small_feeds(frames))


def export_paper(net: FrameNet, path: Path, metadata: Mapping[str, str], frames: MaskedFrames) -> float:
    """Write one of the paper's networks to `path`; return the largest difference of its probabilities to torch's.

    Raises:
        ModelError: As `write_checked`.
    """
    rounded: Any = copy.deepcopy(net).to("cpu")
    rounded.to(memory_format=torch.contiguous_format)
    _round_to_float16(rounded)
    feeds = ({"frame": np.array(frames.frame[at : at + 1])} for at in range(min(CHECKED_FRAMES, len(frames))))
    example = {"frame": np.array(frames.frame[:1])}
    return write_checked(_FrameProbabilityNet(rounded).eval(), example, path, metadata, feeds)


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


def write_int8(
    path: Path, target: Path, sample: Iterable[Feed], operators: Sequence[str] = QUANTIZED_OPERATORS
) -> None:
    """Write the network of `path` to `target` with weights and activations in int8: smaller, on some processors faster.

    Each output channel of a convolution has its own scale; the range of activations is that on the sample. The
    metadata are kept, with ` --int8` after the command.
    """
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)  # it recommends what is done here already
    try:
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            prepared = Path(folder) / "prepared.onnx"
            quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
            quantize_static(
                str(prepared),
                str(target),
                _CalibrationSample(sample),
                quant_format=QuantFormat.QDQ,
                activation_type=QuantType.QUInt8,
                weight_type=QuantType.QInt8,
                per_channel=True,
                op_types_to_quantize=list(operators),
            )
    finally:
        root.setLevel(level)
    model: Any = onnx.load(str(target))
    del model.metadata_props[:]
    for entry in onnx.load(str(path)).metadata_props:
        value = f"{entry.value} --int8" if entry.key == "command" else entry.value
        model.metadata_props.add(key=entry.key, value=value)
    onnx.save(model, str(target))


def open_session(path: Path, threads: int = 1) -> Any:
    """Return an onnxruntime session of a file, on the CPU."""
    options = ort.SessionOptions()
    options.log_severity_level = 3
    options.intra_op_num_threads = threads
    return ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])


class _FrameProbabilityNet(nn.Module):
    """Returns probabilities instead of logits."""

    def __init__(self, net: FrameNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor) -> Tensor:
        return torch.sigmoid(self.net(frame))


class _CalibrationSample:
    """The quantizer's interface to its input, one frame at a time, None at the end."""

    def __init__(self, sample: Iterable[Feed]) -> None:
        self._feeds = iter(sample)

    def get_next(self) -> Feed | None:
        return next(self._feeds, None)

    def __iter__(self) -> Iterator[Feed]:
        while (feed := self.get_next()) is not None:
            yield feed

    def set_range(self, start_index: int, end_index: int) -> None:
        """Do nothing: the sample is small and read as a whole."""


def _metadata(
    contract: str, command: str, seed: int, threshold: float, label: str, size_px: tuple[int, int]
) -> dict[str, str]:
    return {
        "slipguard_contract": contract,
        "threshold": f"{threshold:g}",
        "label": label,
        "command": command,
        "seed": str(seed),
        "input_size": f"{size_px[0]}x{size_px[1]}",
    }


def _small_feeds(frames: RenderedFrames) -> Iterator[Feed]:
    """Yield inputs, every other one without a known background image."""
    for index in range(min(CHECKED_FRAMES, len(frames))):
        frame, background = (np.array(some[index : index + 1]) for some in (frames.frame, frames.background))
        yield dict(zip(INPUTS, (frame, background, np.array([float(index % 2)], np.float32)), strict=True))


def _round_to_float16(net: nn.Module) -> None:
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
