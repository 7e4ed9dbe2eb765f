"""The paper's network in shape alone: DeepLabV3+ with a ResNet18 encoder, for timing beside ours.

The layers and sizes are those of segmentation-models-pytorch's DeepLabV3Plus("resnet18"), normalisation folded into the
convolutions as onnxruntime does. The weights are made up: waves that the graph itself computes from a few numbers,
so the file is small; onnxruntime computes them once, when the session opens, and then runs on dense weights as it
would on learnt ones. Nothing can be said of its accuracy. Made with
`python -m slipguard.bench.peer FILE` (train extra).
"""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import onnxruntime as ort
from numpy.typing import NDArray

from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import ModelError
from slipguard.perception.contact.segmenter import default_model_path

if TYPE_CHECKING:
    import onnx

PEER_MODEL = "peer-deeplabv3plus-resnet18-timing.onnx"
_STAGES = ((64, 1, 1), (128, 2, 1), (256, 2, 1), (512, 1, 2))
"""Channels, stride and dilation of ResNet18's four stages at output stride 16."""
_RATES = (12, 24, 36)
_MEAN, _STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


class Peer:
    """The paper's two stages: segmentation at 240 x 320 in float32 on one thread, thinning by OpenCV."""

    def __init__(self, path: Path | None = None) -> None:
        path = default_model_path().with_name(PEER_MODEL) if path is None else path
        options = ort.SessionOptions()
        options.intra_op_num_threads = options.inter_op_num_threads = 1
        options.log_severity_level = 3
        try:
            self._session: Any = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:
            raise ModelError(
                f"{path}: the peer network cannot be opened; make it with python -m slipguard.bench.peer"
            ) from error

    def run(self, image: NDArray[np.uint8], mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Segment `image`, thin `mask` in place of the senseless answer; both at frame size. Returns the skeleton."""
        mean, std = np.asarray(_MEAN, np.float32), np.asarray(_STD, np.float32)
        rgb = (image[..., ::-1].astype(np.float32) / np.float32(255.0) - mean) / std
        answer = self._session.run(None, {"image": np.ascontiguousarray(rgb.transpose(2, 0, 1)[None])})[0]
        if not np.isfinite(answer).all():
            raise ModelError("the peer network's answer is not finite; make its file again")
        thinned = cv2.ximgproc.thinning(mask * np.uint8(255), thinningType=cv2.ximgproc.THINNING_GUOHALL)
        return np.asarray(thinned, np.uint8)


class _Graph:
    """Collects nodes; every method appends one layer and returns the name of its output."""

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
        """Weights: a sine of whole numbers, dense, of mean about 0, without a period that matters."""
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


def make_peer(path: Path) -> None:
    """Write the timing network to `path`. Needs the package `onnx` (train extra)."""
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


if __name__ == "__main__":
    make_peer(Path(sys.argv[1]))
