"""A network in whole numbers of eight bits, calibrated on frames: smaller, and quicker on some processors."""

from __future__ import annotations

import logging
import tempfile
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import onnx
from numpy.typing import NDArray

CALIBRATION_FRAMES = 64
"""How many frames tell the range of activations."""
CONVOLUTIONS = ("Conv",)
MOST = (*CONVOLUTIONS, "Relu", "MaxPool", "Add")

Feed = Mapping[str, NDArray[Any]]


def quantised(path: Path, target: Path, sample: Iterable[Feed], operators: Sequence[str] = MOST) -> None:
    """Write the network of `path` to `target` with weights and activations in int8.

    One scale per output channel of each convolution, activations by their smallest and largest value on the sample:
    inputs by name, one frame each. The metadata are kept, with ` --int8` after the command.
    """
    from onnxruntime.quantization import QuantFormat, QuantType, quantize_static
    from onnxruntime.quantization.shape_inference import quant_pre_process

    root = logging.getLogger()
    level = root.level
    root.setLevel(logging.ERROR)  # it advises what is done here already
    try:
        with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")
            prepared = Path(folder) / "prepared.onnx"
            quant_pre_process(str(path), str(prepared), skip_symbolic_shape=True)
            quantize_static(
                str(prepared),
                str(target),
                _Sample(sample),
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


class _Sample:
    """What the quantiser asks for input, one frame at a time, until None."""

    def __init__(self, sample: Iterable[Feed]) -> None:
        self._feeds = iter(sample)

    def get_next(self) -> Feed | None:
        return next(self._feeds, None)

    def __iter__(self) -> Iterator[Feed]:
        while (feed := self.get_next()) is not None:
            yield feed

    def set_range(self, start_index: int, end_index: int) -> None:
        """Part of the quantiser's interface; the sample is small and read as a whole."""
