"""A training in one picture: the loss, and Dice and IoU on held-out frames, epoch by epoch."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from slipguard.tools.plotting import figure, save
from slipguard.training.paper.training import Epoch


def draw_curves(history: Sequence[Epoch], title: str, path: Path) -> None:
    """Write the picture. Raises InputError when it cannot be written."""
    drawing = figure(8.0, 3.4)
    left, right = drawing.subplots(1, 2)
    numbers = [epoch.number for epoch in history]
    left.plot(numbers, [epoch.loss for epoch in history], "o-", color="tab:red", label="training")
    left.set(xlabel="epoch", ylabel="focal loss", title=title)
    left.set_ylim(bottom=0.0)
    for name, colour in (("dice", "tab:blue"), ("iou", "tab:orange")):
        values = [getattr(epoch, name) for epoch in history]
        label = f"{'Dice' if name == 'dice' else 'IoU'}, {values[-1]:.3f} at the end"
        right.plot(numbers, values, "o-", color=colour, label=label)
    right.set(xlabel="epoch", ylabel="mean over held-out frames", ylim=(0.0, 1.0))
    for axes in (left, right):
        axes.set_xticks(numbers if len(numbers) <= 12 else numbers[:: len(numbers) // 10])
        axes.grid(alpha=0.3)
        axes.legend(loc="lower right" if axes is right else "upper right")
    save(drawing, path)
