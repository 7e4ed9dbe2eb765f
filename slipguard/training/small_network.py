"""The small segmentation network: from a frame and the background image to the contact probability.

The network needs the *change* since the unit's background image, so the difference is part of the graph: training and
use cannot differ. Light drifts by a few gray levels from press to press. A clipped mean over the difference image
estimates that level, which is subtracted; a contact patch hardly affects it because its large values are clipped.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from slipguard.perception.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX

WIDTHS = (16, 32, 64)
"""Channels at a half, a quarter and an eighth of the input. Multiples of 16: onnxruntime computes these in blocks."""
DILATIONS = (1, 2, 4, 1, 2, 4)
"""Of the blocks at an eighth; together they see the whole image."""
MIDDLE_GRAY = 96.0


class _Block(nn.Module):
    """A residual 3x3 convolution, separable: each channel by itself, then a mix of the channels in every pixel."""

    def __init__(self, channels: int, dilation: int = 1) -> None:
        super().__init__()
        self.change = nn.Sequential(
            nn.Conv2d(channels, channels, 3, 1, dilation, dilation, channels, bias=False),
            nn.BatchNorm2d(channels),
            nn.ReLU(inplace=True),
            nn.Conv2d(channels, channels, 1, bias=False),
            nn.BatchNorm2d(channels),
        )

    def forward(self, x: Tensor) -> Tensor:
        return torch.relu(x + self.change(x))


def _halved(inputs: int, outputs: int) -> nn.Sequential:
    conv = nn.Conv2d(inputs, outputs, 3, 2, 1, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class SmallNet(nn.Module):
    """Encoder-decoder with three strides of two, separable blocks, global context and a sub-pixel head.

    Full resolution takes most of the time on one core: the first convolution has a stride, and the head restores the
    resolution by depth-to-space. The position of a contour depends on the deepest press anywhere in the image, so at
    the coarsest level every place gets the mean and the maximum of the whole image.

    `forward` takes frame and background, (N, 160, 120, 3) uint8 BGR, halved by area, and background_known, (N,) float:
    1 if `background` is the unit's background image, 0 if it is estimated from the frame. It returns logits
    (N, 1, 160, 120).
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c = WIDTHS
        self.down_half = _halved(6, a)
        self.down_quarter = nn.Sequential(_halved(a, b), _Block(b), _Block(b))
        self.down_eighth = nn.Sequential(_halved(b, c), _Block(c))
        self.context = nn.Sequential(nn.Conv2d(2 * c + 1, c, 1), nn.ReLU(inplace=True), nn.Conv2d(c, c, 1))
        self.middle = nn.Sequential(*(_Block(c, dilation) for dilation in DILATIONS))
        self.to_quarter = nn.Conv2d(c, b, 1)
        self.up_quarter = nn.Sequential(_Block(b), _Block(b))
        self.to_half = nn.Conv2d(b, a, 1)
        self.up_half = _Block(a)
        self.head = nn.Conv2d(a, 4, 1)

    def forward(self, frame: Tensor, background: Tensor, background_known: Tensor) -> Tensor:
        half = self.down_half(_inputs(frame.permute(0, 3, 1, 2).float(), background.permute(0, 3, 1, 2).float()))
        quarter = self.down_quarter(half)
        eighth = self.down_eighth(quarter)
        whole = (eighth.mean((2, 3), keepdim=True), eighth.amax((2, 3), keepdim=True))
        eighth = self.middle(eighth + self.context(torch.cat((*whole, background_known.view(-1, 1, 1, 1)), 1)))
        quarter = self.up_quarter(quarter + nn.functional.interpolate(self.to_quarter(eighth), scale_factor=2.0))
        half = self.up_half(half + nn.functional.interpolate(self.to_half(quarter), scale_factor=2.0))
        return nn.functional.pixel_shuffle(self.head(half), 2)


def _inputs(frame: Tensor, background: Tensor) -> Tensor:
    change = frame - background
    sparse = change[:, :, ::4, ::4]
    level = sparse.clamp(-12.0, 12.0).mean((2, 3), keepdim=True)
    level = level + (sparse - level).clamp(-6.0, 6.0).mean((2, 3), keepdim=True)
    return torch.cat((change - level, frame - MIDDLE_GRAY), 1)


class ProbabilityNet(nn.Module):
    """Returns probabilities (N, 1, 160, 120) in 0..1 instead of logits."""

    def __init__(self, net: SmallNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor, background: Tensor, background_known: Tensor) -> Tensor:
        return torch.sigmoid(self.net(frame, background, background_known))


def example_inputs() -> tuple[Tensor, Tensor, Tensor]:
    """Return zeros of the right shapes and types, to trace the network with."""
    image = torch.zeros((1, INPUT_HEIGHT_PX, INPUT_WIDTH_PX, 3), dtype=torch.uint8)
    return image, image.clone(), torch.ones(1)
