"""Weights stored in half the bytes and computed with in full precision: float16 in the file, float32 in use."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from torch import nn

HALVED_FROM = 1024
"""Arrays of at least this many weights are stored so: the convolutions, where the size is."""


def round_to_half(net: nn.Module) -> None:
    """Round the large weights of a network to what float16 can hold, so that nothing is lost when they are stored."""
    with torch.no_grad():
        for weights in net.parameters():
            if weights.numel() >= HALVED_FROM:
                weights.copy_(weights.half().float())


def store_as_half(model: Any) -> None:
    """Replace the float32 weights of an ONNX model that float16 holds exactly by float16 and a cast to float32.

    onnxruntime casts once, when a session opens.
    """
    casts = []
    for weights in model.graph.initializer:
        values: NDArray[Any] = numpy_helper.to_array(weights)
        halves = values.astype(np.float16)
        if weights.data_type != TensorProto.FLOAT or values.size < HALVED_FROM or not np.array_equal(values, halves):
            continue
        name = weights.name
        weights.CopyFrom(numpy_helper.from_array(halves, f"{name}.half"))
        casts.append(helper.make_node("Cast", [f"{name}.half"], [name], to=TensorProto.FLOAT))
    for cast in reversed(casts):
        model.graph.node.insert(0, cast)
