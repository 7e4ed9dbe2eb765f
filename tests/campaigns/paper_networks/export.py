"""Export of a network of the paper."""

from __future__ import annotations

import copy
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from slipguard.training.onnx_export import CHECKED_FRAMES, round_to_float16, write_checked
from tests.campaigns.paper_networks.frames import MaskedFrames
from tests.campaigns.paper_networks.networks import FrameNet


def export_paper(net: FrameNet, path: Path, metadata: Mapping[str, str], frames: MaskedFrames) -> float:
    """Write one of the paper's networks to `path`; return the largest difference of its probabilities to torch's.

    Raises:
        ModelError: As `write_checked`.
    """
    rounded: Any = copy.deepcopy(net).to("cpu")
    rounded.to(memory_format=torch.contiguous_format)
    round_to_float16(rounded)
    feeds = ({"frame": np.array(frames.frame[at : at + 1])} for at in range(min(CHECKED_FRAMES, len(frames))))
    example = {"frame": np.array(frames.frame[:1])}
    return write_checked(_FrameProbabilityNet(rounded).eval(), example, path, metadata, feeds)


class _FrameProbabilityNet(nn.Module):
    """Returns probabilities instead of logits."""

    def __init__(self, net: FrameNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor) -> Tensor:
        return torch.sigmoid(self.net(frame))
