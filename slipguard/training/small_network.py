"""The small segmentation network: from a frame and the background image to the contact probability.

The network needs the *change* since the unit's background image, so the difference is part of the graph: training and
use cannot differ. Light drifts by a few gray levels from press to press. A clipped mean over the difference image
estimates that level, which is subtracted; a contact patch hardly affects it because its large values are clipped.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from slipguard.perception.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX

WIDTHS = (16, 32, 64, 96)
"""Channels at a half, a quarter, an eighth and a sixteenth of the input."""
SCALE = 1.0 / 48.0
"""Gray levels to network units: a strong imprint is about 50 to 100 gray levels."""


def _conv(inputs: int, outputs: int, *, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    conv = nn.Conv2d(inputs, outputs, 3, stride, dilation, dilation, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class SmallNet(nn.Module):
    """Encoder-decoder with four strides of two, global context at the coarsest level and a sub-pixel head.

    Full resolution takes most of the time on one core: the first convolution has a stride, and the head restores the
    resolution by depth-to-space. The position of a contour depends on the deepest press anywhere in the image, so at
    the coarsest level every place gets the mean and the maximum of the whole image.

    `forward` takes frame and background, (N, 160, 120, 3) uint8 BGR, halved by area, and background_known, (N,) float:
    1 if `background` is the unit's background image, 0 if it is estimated from the frame. It returns logits
    (N, 1, 160, 120).
    """

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = WIDTHS
        self.stem = nn.Conv2d(6, a, 5, 2, 2)
        self.known = nn.Parameter(torch.zeros(1, a, 1, 1))
        self.stem_rest = nn.Sequential(nn.BatchNorm2d(a), nn.ReLU(inplace=True))
        self.down1 = nn.Sequential(_conv(a, b, stride=2), _conv(b, b))
        self.down2 = _conv(b, c, stride=2)
        self.middle = _conv(c, c)
        self.context = _GlobalContext(c, d)
        self.side2 = nn.Conv2d(c, b, 1)
        self.up2 = _conv(b, b)
        self.side1 = nn.Conv2d(b, a, 1)
        self.up1 = _conv(a, a)
        self.head = nn.Conv2d(a, 4, 3, 1, 1)

    def forward(self, frame: Tensor, background: Tensor, background_known: Tensor) -> Tensor:
        inputs = _inputs(frame.permute(0, 3, 1, 2).float(), background.permute(0, 3, 1, 2).float())
        half = self.stem_rest(self.stem(inputs) + self.known * background_known.view(-1, 1, 1, 1))
        quarter = self.down1(half)
        eighth = self.down2(quarter)
        eighth = self.context(eighth + self.middle(eighth))
        quarter = self.up2(quarter + nn.functional.interpolate(self.side2(eighth), scale_factor=2.0))
        half = self.up1(half + nn.functional.interpolate(self.side1(quarter), scale_factor=2.0))
        return nn.functional.pixel_shuffle(self.head(half), 2)


def _inputs(image: Tensor, background: Tensor) -> Tensor:
    change = image - background
    level = change.clamp(-12.0, 12.0).mean((2, 3), keepdim=True)
    level = level + (change - level).clamp(-6.0, 6.0).mean((2, 3), keepdim=True)
    return torch.cat(((change - level) * SCALE, (image - 96.0) * (SCALE / 2)), 1)


class _GlobalContext(nn.Module):
    """The level at a sixteenth of the input, where every place gets the mean and maximum of the whole image."""

    def __init__(self, outer: int, width: int) -> None:
        super().__init__()
        self.down = _conv(outer, width, stride=2)
        self.pooled = nn.Sequential(nn.Conv2d(2 * width, width, 1), nn.ReLU(), nn.Conv2d(width, width, 1))
        self.blocks = nn.ModuleList(_conv(width, width, dilation=dilation) for dilation in (1, 2))
        self.side = nn.Conv2d(width, outer, 1)
        self.up = _conv(outer, outer)

    def forward(self, outer: Tensor) -> Tensor:
        inner = self.down(outer)
        inner = inner + self.pooled(torch.cat((inner.mean((2, 3), keepdim=True), inner.amax((2, 3), keepdim=True)), 1))
        for block in self.blocks:
            inner = inner + block(inner)
        height, width = outer.shape[2:]
        back = nn.functional.interpolate(self.side(inner), scale_factor=2.0)[:, :, :height, :width]
        mixed: Tensor = self.up(outer + back)
        return mixed


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
