"""The small segmentation network: frame and no-contact image in, contact probability out.

What a camera-to-mask network needs to see is the *change* against the unit's no-contact image, so the difference is
formed inside the graph, where it costs nothing extra and training and use cannot disagree about it. Light drifts by a
few grey levels from press to press; a clipped mean over the difference image finds that level (a contact patch moves
it little because its large values are clipped) and takes it away.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from slipguard.perception.segment import INPUT_HEIGHT_PX, INPUT_WIDTH_PX

SCALE = 1.0 / 48.0
"""Grey levels to network units: a strong imprint is about 50 to 100 grey levels."""


def _conv(inputs: int, outputs: int, *, size: int = 3, stride: int = 1, dilation: int = 1) -> nn.Sequential:
    pad = dilation * (size // 2)
    conv = nn.Conv2d(inputs, outputs, size, stride, pad, dilation, bias=False)
    return nn.Sequential(conv, nn.BatchNorm2d(outputs), nn.ReLU(inplace=True))


class SmallNet(nn.Module):
    """Encoder-decoder with three strides of two, a dilated bottom and a sub-pixel head.

    Full resolution is where time goes on one core: the first convolution strides at once, and the head
    restores it by depth-to-space. frame, background: (N, 160, 120, 3) uint8 BGR, area-halved images;
    background_known: (N,) float, 1 where `background` is the unit's no-contact image, 0 where it is a smooth guess
    made from the frame. Returns logits (N, outputs, 160, 120).
    """

    def __init__(self, widths: tuple[int, int, int] = (16, 32, 64), bottom: int = 3, outputs: int = 1) -> None:
        super().__init__()
        a, b, c = widths
        self.stem = nn.Conv2d(6, a, 5, 2, 2)
        self.known = nn.Parameter(torch.zeros(1, a, 1, 1))
        self.stem_rest = nn.Sequential(nn.BatchNorm2d(a), nn.ReLU(inplace=True))
        self.down1 = nn.Sequential(_conv(a, b, stride=2), _conv(b, b))
        self.down2 = _conv(b, c, stride=2)
        self.bottom = nn.ModuleList(_conv(c, c, dilation=2**n) for n in range(bottom))
        self.side2 = nn.Conv2d(c, b, 1)
        self.up2 = _conv(b, b)
        self.side1 = nn.Conv2d(b, a, 1)
        self.up1 = _conv(a, a)
        self.head = nn.Conv2d(a, 4 * outputs, 3, 1, 1)

    def forward(self, frame: Tensor, background: Tensor, background_known: Tensor) -> Tensor:
        image = frame.permute(0, 3, 1, 2).float()
        change = image - background.permute(0, 3, 1, 2).float()
        level = change.clamp(-12.0, 12.0).mean((2, 3), keepdim=True)
        level = level + (change - level).clamp(-6.0, 6.0).mean((2, 3), keepdim=True)
        seen = torch.cat(((change - level) * SCALE, (image - 96.0) * (SCALE / 2)), 1)
        half = self.stem_rest(self.stem(seen) + self.known * background_known.view(-1, 1, 1, 1))
        quarter = self.down1(half)
        eighth = self.down2(quarter)
        for block in self.bottom:
            eighth = eighth + block(eighth)
        quarter = self.up2(quarter + nn.functional.interpolate(self.side2(eighth), scale_factor=2.0))
        half = self.up1(half + nn.functional.interpolate(self.side1(quarter), scale_factor=2.0))
        return nn.functional.pixel_shuffle(self.head(half), 2)


class Exported(nn.Module):
    """The network as shipped: probabilities (N, 1, 160, 120) in 0..1 instead of logits."""

    def __init__(self, net: SmallNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, frame: Tensor, background: Tensor, background_known: Tensor) -> Tensor:
        return torch.sigmoid(self.net(frame, background, background_known))


def example_inputs() -> tuple[Tensor, Tensor, Tensor]:
    """Zeros of the right shapes and types, to trace the network with."""
    image = torch.zeros((1, INPUT_HEIGHT_PX, INPUT_WIDTH_PX, 3), dtype=torch.uint8)
    return image, image.clone(), torch.ones(1)
