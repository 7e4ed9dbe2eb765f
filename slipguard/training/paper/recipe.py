"""How the paper's networks are trained: as published, and a shorter way for a plain CPU.

Published (Castaño-Amorós and Gil, "Rotational Slippage Prediction from Segmentation of Tactile Images"): 3,675 images
of 16 objects, focal loss, Adam at 1e-4, batches of 32, 30 epochs.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum

FRAMES = 3675
HELD_OUT = 320
"""Rendered frames of the same 16 objects, by sensor units and in poses that training never shows."""
FOCAL_GAMMA = 2.0


class Arch(StrEnum):
    """The three networks compared in the paper, each with a ResNet18 encoder."""

    deeplabv3plus = "deeplabv3plus"
    pspnet = "pspnet"
    unetplusplus = "unetplusplus"


class Schedule(StrEnum):
    """The learning rate over a training: the same throughout, or up for a fifth of it and down to nothing."""

    constant = "constant"
    one_cycle = "one-cycle"


@dataclass(frozen=True, slots=True)
class Recipe:
    """What decides the outcome of a training, besides network, frames and seed.

    width_px, height_px: of what the network sees. rate: Adam's, the highest of the schedule. mirrored: a random half of
    the frames is shown upside down, a random half left to right.
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
