"""The small network as an ONNX file that keeps the model contract, checked against torch."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from slipguard.datasets.frame_cache import RenderedFrames
from slipguard.perception.contact.segmenter import CONTRACT, INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.sim.contact_label import LABEL_NAME
from slipguard.training.float16_weights import round_to_half
from slipguard.training.onnx_file import CHECKED_FRAMES, Feed, file_metadata, write_compared
from slipguard.training.small_network import Exported, SmallNet, example_inputs

INPUTS = ("frame", "background", "background_known")


def contract_metadata(command: str, seed: int, threshold: float) -> dict[str, str]:
    """What the model contract wants in the file beside the graph."""
    return file_metadata(CONTRACT, command, seed, threshold, LABEL_NAME, (INPUT_WIDTH_PX, INPUT_HEIGHT_PX))


def export_onnx(net: SmallNet, path: Path, metadata: Mapping[str, str], frames: RenderedFrames) -> float:
    """Write `net` to `path`; return the largest difference of its probabilities to torch's on rendered frames.

    Large weights are rounded to float16 and stored so; what computes is float32, and torch is asked with the rounded.
    Raises as `write_compared`.
    """
    placed = copy.deepcopy(net)
    round_to_half(placed)
    example = dict(zip(INPUTS, (one.numpy() for one in example_inputs()), strict=True))
    return write_compared(Exported(placed).eval(), example, path, metadata, _feeds(frames))


def _feeds(frames: RenderedFrames) -> Iterator[Feed]:
    """Every other one without the no-contact image."""
    for index in range(min(CHECKED_FRAMES, len(frames))):
        frame, background = (np.array(some[index : index + 1]) for some in (frames.frame, frames.background))
        yield dict(zip(INPUTS, (frame, background, np.array([float(index % 2)], np.float32)), strict=True))
