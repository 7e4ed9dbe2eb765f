"""A network with the layers of the paper's, for timing: DeepLabV3+ with a ResNet18 encoder and arbitrary weights.

Layers and sizes are those of segmentation-models-pytorch's DeepLabV3Plus("resnet18") with the normalization folded into
the convolutions, as onnxruntime does. The graph computes its weights as sines of a few numbers, which keeps the file
small; onnxruntime computes them once, when the session opens, and then runs on dense weights as for trained ones. The
network's output has no meaning.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX

if TYPE_CHECKING:
    import onnx

_STAGES = ((64, 1, 1), (128, 2, 1), (256, 2, 1), (512, 1, 2))
"""Channels, stride and dilation of ResNet18's four stages at output stride 16."""
_RATES = (12, 24, 36)


class _Graph:
    """A list of nodes; each method appends one layer and returns the name of its output."""

    def __init__(self) -> None:
        from onnx import helper, numpy_helper

        self._helper, self._numpy = helper, numpy_helper
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []
        self._count = 0

    def node(self, kind: str, inputs: list[str], **attributes: Any) -> str:
        self._count += 1
        name = f"{kind.lower()}{self._count}"
        self.nodes.append(self._helper.make_node(kind, inputs, [name], **attributes))
        return name

    def constant(self, value: NDArray[Any] | float) -> str:
        self._count += 1
        array = np.float32(value) if isinstance(value, float) else value
        self.constants.append(self._numpy.from_array(np.asarray(array), f"c{self._count}"))
        return f"c{self._count}"

    def waves(self, shape: tuple[int, ...], amplitude: float) -> str:
        """Append weights: the sine of consecutive integers, dense, with a mean of about 0."""
        count = math.prod(shape)
        numbers = self.node("Range", [self.constant(0.0), self.constant(float(count)), self.constant(1.0)])
        phase = self.node("Mul", [numbers, self.constant(1.2345 + 0.0007 * self._count)])
        sized = self.node("Mul", [self.node("Sin", [phase]), self.constant(amplitude)])
        return self.node("Reshape", [sized, self.constant(np.asarray(shape, np.int64))])

    def conv(
        self,
        x: str,
        inputs: int,
        outputs: int,
        kernel: int,
        stride: int = 1,
        dilation: int = 1,
        groups: int = 1,
        relu: bool = True,
    ) -> str:
        fan_in = kernel * kernel * inputs // groups
        weights = self.waves((outputs, inputs // groups, kernel, kernel), 2.0 / math.sqrt(fan_in))
        bias = self.constant(np.full(outputs, 0.01, np.float32))
        pad = dilation * (kernel // 2)
        y = self.node(
            "Conv",
            [x, weights, bias],
            kernel_shape=[kernel, kernel],
            strides=[stride, stride],
            dilations=[dilation, dilation],
            group=groups,
            pads=[pad] * 4,
        )
        return self.node("Relu", [y]) if relu else y

    def separable(self, x: str, inputs: int, outputs: int, dilation: int = 1) -> str:
        x = self.conv(x, inputs, inputs, 3, dilation=dilation, groups=inputs, relu=False)
        return self.conv(x, inputs, outputs, 1)

    def block(self, x: str, inputs: int, outputs: int, stride: int, dilation: int) -> str:
        y = self.conv(x, inputs, outputs, 3, stride, dilation)
        y = self.conv(y, outputs, outputs, 3, 1, dilation, relu=False)
        if stride != 1 or inputs != outputs:
            x = self.conv(x, inputs, outputs, 1, stride, relu=False)
        return self.node("Relu", [self.node("Add", [x, y])])

    def enlarge(self, x: str, factor: float) -> str:
        scales = self.constant(np.array([1, 1, factor, factor], np.float32))
        return self.node("Resize", [x, "", scales], mode="linear", coordinate_transformation_mode="align_corners")


def write_timing_network(path: Path) -> None:
    """Write the network to `path`. Needs the package `onnx` (train extra)."""
    import onnx
    from onnx import TensorProto, helper

    g = _Graph()
    x = g.conv("image", 3, 64, 7, 2)
    x = g.node("MaxPool", [x], kernel_shape=[3, 3], strides=[2, 2], pads=[1, 1, 1, 1])
    channels, fine = 64, ""
    for outputs, stride, dilation in _STAGES:
        x = g.block(x, channels, outputs, stride, dilation)
        x = g.block(x, outputs, outputs, 1, dilation)
        channels = outputs
        fine = fine or x
    branches = [g.conv(x, 512, 256, 1), *(g.separable(x, 512, 256, rate) for rate in _RATES)]
    pooled = g.conv(g.node("GlobalAveragePool", [x]), 512, 256, 1)
    size = g.constant(np.array([1, 256, FRAME_HEIGHT_PX // 16, FRAME_WIDTH_PX // 16], np.int64))
    branches.append(g.node("Expand", [pooled, size]))
    x = g.conv(g.node("Concat", branches, axis=1), 1280, 256, 1)
    x = g.enlarge(g.separable(x, 256, 256), 4.0)
    x = g.node("Concat", [x, g.conv(fine, 64, 48, 1)], axis=1)
    x = g.conv(g.separable(x, 304, 256), 256, 1, 1, relu=False)
    x = g.enlarge(x, 4.0)
    g.nodes.append(helper.make_node("Sigmoid", [x], ["probability"]))
    frame = [1, 3, FRAME_HEIGHT_PX, FRAME_WIDTH_PX]
    graph = helper.make_graph(
        g.nodes,
        "deeplabv3plus_resnet18_for_timing",
        [helper.make_tensor_value_info("image", TensorProto.FLOAT, frame)],
        [helper.make_tensor_value_info("probability", TensorProto.FLOAT, [1, 1, *frame[2:]])],
        g.constants,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], producer_name="slipguard")
    model.ir_version = 8
    model.metadata_props.add(key="purpose", value="timing only: made-up weights")
    onnx.checker.check_model(model)
    path.write_bytes(model.SerializeToString())
