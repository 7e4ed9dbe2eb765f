"""Quantization of an exported network to int8."""

from __future__ import annotations

import logging
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import onnx

from slipguard.training.onnx_export import Feed

CALIBRATION_FRAMES = 64
"""Frames that define the range of int8 activations."""
CONVOLUTIONS = ("Conv",)
QUANTIZED_OPERATORS = (*CONVOLUTIONS, "Relu", "MaxPool", "Add")


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
