"""DeepLabV3+, PSPNet and UNet++ with a ResNet18 encoder, built by segmentation-models-pytorch.

Their input is the frame alone, as in the paper. Normalization and the padding for their strides are part of the
network, so that training and use cannot differ.
"""

from __future__ import annotations

import copy
import importlib
import sys
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from slipguard.errors import InputError
from slipguard.training.onnx_export import CHECKED_FRAMES, round_to_float16, write_checked
from tests.campaigns.paper_networks.recipe import Arch

ENCODER = "resnet18"
STRIDE_PX = {Arch.deeplabv3plus: 16, Arch.pspnet: 8, Arch.unetplusplus: 32}
"""Stride of the coarsest grid: sides are padded to a multiple of it."""
_MEAN_RGB, _STD_RGB = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of ImageNet, in 0..1, usual for these encoders."""
_CLASSES = {Arch.deeplabv3plus: "DeepLabV3Plus", Arch.pspnet: "PSPNet", Arch.unetplusplus: "UnetPlusPlus"}
_OPERATORS = (
    "nms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
    "qnms(Tensor dets, Tensor scores, float iou_threshold) -> Tensor",
)
_declared: list[Any] = []
"""Keeps the declarations alive: they vanish with their library object."""


class FrameNet(nn.Module):
    """One of the three, for frames of one size, with random weights.

    `forward` takes frames (N, H, W, 3) uint8 BGR and returns logits (N, 1, H, W).

    Raises:
        InputError: segmentation-models-pytorch is not installed.
    """

    mean: Tensor
    scale: Tensor

    def __init__(self, arch: Arch, height_px: int, width_px: int) -> None:
        super().__init__()
        build = getattr(segmentation_models(), _CLASSES[arch])
        self.net = build(ENCODER, encoder_weights=None, in_channels=3, classes=1)
        stride = STRIDE_PX[arch]
        self.pad = (-height_px % stride, -width_px % stride)
        if arch is Arch.pspnet:
            grid = ((height_px + self.pad[0]) // stride, (width_px + self.pad[1]) // stride)
            pyramid = self.net.decoder.psp
            pyramid.blocks = nn.ModuleList(_PyramidLevel(level, grid) for level in pyramid.blocks)
        self.register_buffer("mean", torch.tensor(_MEAN_RGB).view(1, 3, 1, 1) * 255.0, persistent=False)
        self.register_buffer("scale", 1.0 / (torch.tensor(_STD_RGB).view(1, 3, 1, 1) * 255.0), persistent=False)

    def forward(self, frame: Tensor) -> Tensor:
        height, width = frame.shape[1:3]
        rgb = (frame.permute(0, 3, 1, 2).float().flip(1) - self.mean) * self.scale
        rows, columns = self.pad
        if rows or columns:
            rgb = nn.functional.pad(rgb, (0, columns, 0, rows), mode="replicate")
        logits: Tensor = self.net(rgb)
        return logits[..., :height, :width]

    def start_encoder_from(self, path: Path) -> None:
        """Load the encoder's weights from those of a ResNet18 (a torch state dict, such as torchvision's)."""
        _load(self.net.encoder, path, f"the weights of a {ENCODER}")

    def start_from(self, path: Path) -> None:
        """Load all weights from those of an earlier training of the same network."""
        _load(self, path, f"the weights of this {type(self.net).__name__}")


def _load(part: Any, path: Path, what: str) -> None:
    try:
        part.load_state_dict(dict(torch.load(path, map_location="cpu", weights_only=True)))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); set a file of weights") from error
    except Exception as error:
        reason = str(error).strip().splitlines()[0][:120]
        raise InputError(f"{path}: not {what} ({reason}); give a torch state dict of it") from error


class _PyramidLevel(nn.Module):
    """A level of PSPNet's pyramid that averages over unequal cells by two matrix products.

    Equal to `nn.AdaptiveAvgPool2d`, which ONNX cannot express if cells differ in size.
    """

    down: Tensor
    across: Tensor

    def __init__(self, level: Any, grid: tuple[int, int]) -> None:
        super().__init__()
        self.after = level.pool[1]
        down, across = (torch.from_numpy(_cell_means(side, level.pool_size)) for side in grid)
        self.register_buffer("down", down, persistent=False)
        self.register_buffer("across", across.T.contiguous(), persistent=False)

    def forward(self, x: Tensor) -> Tensor:
        size = x.shape[2:]
        cells: Tensor = self.after(self.down.to(x.dtype) @ x @ self.across.to(x.dtype))
        return nn.functional.interpolate(cells, size=size, mode="bilinear", align_corners=True)


def _cell_means(length: int, cells: int) -> NDArray[np.float32]:
    """Return (cells, length): row k averages the range that `nn.AdaptiveAvgPool1d` gives cell k."""
    matrix = np.zeros((cells, length), np.float32)
    for cell in range(cells):
        first, last = cell * length // cells, -(-(cell + 1) * length // cells)
        matrix[cell, first:last] = 1.0 / (last - first)
    return matrix


class _Probability(nn.Module):
    """Returns probabilities instead of logits."""

    def __init__(self, net: FrameNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor) -> Tensor:
        return torch.sigmoid(self.net(frame))


def export_paper(net: FrameNet, path: Path, metadata: Mapping[str, str], frames: NDArray[np.uint8]) -> float:
    """Write the network to `path`; return the largest difference of its probabilities to torch's on the first frames.

    Raises:
        ModelError: As `write_checked`.
    """
    rounded: Any = copy.deepcopy(net).to("cpu")
    rounded.to(memory_format=torch.contiguous_format)
    round_to_float16(rounded)
    feeds = [{"frame": frames[at : at + 1]} for at in range(min(CHECKED_FRAMES, len(frames)))]
    return write_checked(_Probability(rounded).eval(), feeds[0], path, metadata, feeds)


def segmentation_models() -> Any:
    """Return the module segmentation_models_pytorch.

    torchvision's wheels on PyPI are built for CUDA. With a CPU build of torch their library does not load, and the
    import fails because two operators, which no segmentation network uses, are unknown. Only then are they declared,
    without a body.

    Raises:
        InputError: It or torchvision is not installed.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # about the parts of torchvision that read images
        try:
            try:
                importlib.import_module("torchvision")
            except RuntimeError as error:
                if "torchvision::" not in str(error):
                    raise
                _declare_operators()
            return importlib.import_module("segmentation_models_pytorch")
        except ImportError as error:
            raise InputError(
                f"the paper's networks need {error.name or 'segmentation-models-pytorch'}; install with: "
                "pip install 'slipguard[train]' --extra-index-url https://download.pytorch.org/whl/cpu"
            ) from error


def _declare_operators() -> None:
    for name in [name for name in sys.modules if name == "torchvision" or name.startswith("torchvision.")]:
        del sys.modules[name]  # left over from the failed import
    library: Any = torch.library.Library("torchvision", "DEF")  # type: ignore[no-untyped-call]
    for operator in _OPERATORS:
        library.define(operator)
    _declared.append(library)
