"""Recipes for training the paper's networks: as published, and a shorter one for a CPU.

Published (Castaño-Amorós and Gil, "Rotational Slippage Prediction from Segmentation of Tactile Images"): 3,675 images
of 16 objects, focal loss, Adam at 1e-4, batches of 32, 30 epochs.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

FRAMES = 3675
HELD_OUT = 320
"""Rendered frames of the same 16 objects, with sensor units and poses that are not used for training."""
FOCAL_GAMMA = 2.0


class Arch(StrEnum):
    """The three networks compared in the paper, each with a ResNet18 encoder."""

    deeplabv3plus = "deeplabv3plus"
    pspnet = "pspnet"
    unetplusplus = "unetplusplus"


class RecipeName(StrEnum):
    """As published, or shorter, at 120x160, for a CPU."""

    paper = "paper"
    short = "short"


class Schedule(StrEnum):
    """Learning rate over a training: constant, or increasing for a fifth of it and then decreasing to zero."""

    constant = "constant"
    one_cycle = "one-cycle"


@dataclass(frozen=True, slots=True)
class Recipe:
    """What determines a training, with network, frames and seed.

    width_px, height_px: input of the network. rate: highest learning rate of Adam. mirrored: a random half of the
    frames is flipped vertically, a random half horizontally.
    """

    name: str
    width_px: int
    height_px: int
    epochs: int
    batch: int
    rate: float
    schedule: Schedule
    mirrored: bool


PAPER = Recipe("paper", 240, 320, 30, 32, 1e-4, Schedule.constant, mirrored=False)
SHORT = Recipe("short", 120, 160, 3, 8, 1e-3, Schedule.one_cycle, mirrored=True)
RECIPES = {recipe.name: recipe for recipe in (PAPER, SHORT)}
