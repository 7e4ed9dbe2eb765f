"""The paper's networks as ONNX files that keep the model contract, checked against torch before they are in place."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from slipguard.perception.contact.segmenter import CONTRACT_ANY_INPUT
from slipguard.training.float16_weights import round_to_half
from slipguard.training.onnx_file import CHECKED_FRAMES, file_metadata, write_compared
from slipguard.training.paper.frames import MaskedFrames
from slipguard.training.paper.networks import FrameNet


def contract_metadata(
    command: str, seed: int, threshold: float, label: str, size_px: tuple[int, int]
) -> dict[str, str]:
    """What the model contract wants in the file beside the graph. label: what was learnt, in words."""
    return file_metadata(CONTRACT_ANY_INPUT, command, seed, threshold, label, size_px)


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
    asked with the rounded weights. frames: what the check is made on, of the network's size.
    Raises as `write_compared`.
    """
    placed: Any = copy.deepcopy(net).to("cpu")
    placed.to(memory_format=torch.contiguous_format)
    round_to_half(placed)
    feeds = ({"frame": np.array(frames.frame[at : at + 1])} for at in range(min(CHECKED_FRAMES, len(frames))))
    example = {"frame": np.array(frames.frame[:1])}
    return write_compared(_Shipped(placed).eval(), example, path, metadata, feeds)
