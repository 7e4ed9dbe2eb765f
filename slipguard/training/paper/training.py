"""Training of the paper's networks: resumable after every epoch, in mixed precision where the machine has it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError
from slipguard.training.paper.frames import MaskedFrames
from slipguard.training.paper.networks import FrameNet
from slipguard.training.paper.precision import Precision
from slipguard.training.paper.recipe import FOCAL_GAMMA, Arch, Recipe, Schedule

WARM_UP_SHARE = 0.2
CHECKPOINT, HISTORY, WEIGHTS = "checkpoint.pt", "history.json", "weights.pt"


@dataclass(frozen=True, slots=True)
class Settings:
    """What else a training follows from. encoder: where the encoder's first weights came from, in words."""

    arch: Arch
    recipe: Recipe
    frames: int
    seed: int = 0
    encoder: str = "random"
    precision: str = "float32"

    def identity(self) -> dict[str, Any]:
        """As plain values, to keep beside what was trained."""
        values: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return values


@dataclass(frozen=True, slots=True)
class Epoch:
    """loss: mean focal loss; dice, iou: mean over held-out frames; seconds: of the epoch, with its validation."""

    number: int
    loss: float
    dice: float
    iou: float
    seconds: float


def focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Mean over pixels of (1 - p)^2 times the cross-entropy, p the probability of what is there (Lin et al. 2017)."""
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    return ((1.0 - torch.exp(-entropy)) ** FOCAL_GAMMA * entropy).mean()


def train(
    net: FrameNet,
    settings: Settings,
    precision: Precision,
    shown: MaskedFrames,
    held_out: MaskedFrames,
    work: Path,
    on_step: Callable[[int, int], None],
    on_epoch: Callable[[Epoch], None],
) -> list[Epoch]:
    """Train `net` in place, from the last whole epoch found in `work`, and return the figures of all epochs.

    Leaves checkpoint, history (JSON) and the finished weights in `work`. on_step(done, total) counts batches. Raises
    `InputError` for fewer frames than a batch, and where `work` holds another training.
    """
    recipe = settings.recipe
    steps = len(shown) // recipe.batch
    if steps < 1:
        raise InputError(
            f"{len(shown)} frames are fewer than a batch of {recipe.batch}; give more, or a smaller --batch"
        )
    placed: Any = net.to(precision.device)
    placed.to(memory_format=torch.channels_last)
    total = recipe.epochs * steps
    optimiser = torch.optim.Adam(net.parameters(), recipe.rate)
    schedule = _schedule(optimiser, recipe, total)
    parts = (net, optimiser, schedule, precision.scaler)
    history = _resume(work / CHECKPOINT, settings, parts)
    on_step(len(history) * steps, total)
    for number in range(len(history) + 1, recipe.epochs + 1):
        began_s = time.monotonic()
        rng = np.random.default_rng([settings.seed, number])
        torch.manual_seed(int(rng.integers(2**31)))  # dropout: a resumed epoch is the one it would have been
        order = rng.permutation(len(shown))
        net.train()
        losses = 0.0
        for step in range(steps):
            frame, target = _batch(shown, order[step * recipe.batch :][: recipe.batch], recipe.mirrored, rng)
            with precision.autocast():
                logits = net(frame.to(precision.device, non_blocking=True))
            loss = focal_loss(logits.float(), target.to(precision.device, non_blocking=True))
            optimiser.zero_grad(set_to_none=True)
            torch.autograd.backward(precision.scaler.scale(loss))
            precision.scaler.step(optimiser)
            precision.scaler.update()
            schedule.step()
            losses += float(loss.detach())
            on_step((number - 1) * steps + step + 1, total)
        mean_dice, mean_iou = np.mean(overlaps(net, precision, held_out), 0)
        seconds = time.monotonic() - began_s
        history.append(Epoch(number, losses / steps, float(mean_dice), float(mean_iou), seconds))
        _keep(work, settings, parts, history)
        on_epoch(history[-1])
    torch.save({name: value.cpu() for name, value in net.state_dict().items()}, work / WEIGHTS)
    return history


def overlaps(net: FrameNet, precision: Precision, frames: MaskedFrames, threshold: float = 0.5) -> list[list[float]]:
    """[Dice, IoU] of every frame."""
    net.eval()
    out = []
    for start in range(0, len(frames), 16):
        part = slice(start, start + 16)
        with torch.no_grad(), precision.autocast():
            logits = net(torch.from_numpy(np.array(frames.frame[part])).to(precision.device))
        masks = (torch.sigmoid(logits.float()) > threshold)[:, 0].cpu().numpy()
        for mask, truth in zip(masks, frames.mask[part] > 127, strict=True):
            out.append([dice(mask, truth), iou(mask, truth)])
    return out


def _schedule(optimiser: torch.optim.Optimizer, recipe: Recipe, total: int) -> Any:
    if recipe.schedule is Schedule.constant:
        return torch.optim.lr_scheduler.ConstantLR(optimiser, 1.0, 0)
    steps = max(total + 1, 10)  # fewer leave no step for the way up
    return torch.optim.lr_scheduler.OneCycleLR(
        optimiser, recipe.rate, total_steps=steps, pct_start=WARM_UP_SHARE, cycle_momentum=False
    )


def _batch(
    frames: MaskedFrames, pick: NDArray[np.int64], mirrored: bool, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """The frames (N, H, W, 3) uint8 and their masks (N, 1, H, W) float, 0 or 1."""
    pick = np.sort(pick)
    frame, mask = frames.frame[pick], frames.mask[pick]
    if mirrored:
        for axis in (1, 2):
            rotated = rng.random(len(pick)) < 0.5
            for array in (frame, mask):
                array[rotated] = np.flip(array[rotated], axis)
    return torch.from_numpy(np.asarray(frame)), torch.from_numpy((np.asarray(mask)[:, None] > 127).astype(np.float32))


def _resume(path: Path, settings: Settings, parts: tuple[Any, ...]) -> list[Epoch]:
    if not path.is_file():
        return []
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        wanted, found = settings.identity(), saved["settings"]
    except Exception as error:
        raise InputError(f"{path}: no checkpoint of this command; remove it or name another --work") from error
    if found != wanted:
        other = next(key for key in wanted if found.get(key) != wanted[key])
        raise InputError(
            f"{path.parent} holds a training with {other} {found.get(other)}, not {wanted[other]}; "
            "name another --work or remove it"
        )
    for part, state in zip(parts, saved["state"], strict=True):
        part.load_state_dict(state)
    return [Epoch(**line) for line in saved["history"]]


def _keep(work: Path, settings: Settings, parts: tuple[Any, ...], history: list[Epoch]) -> None:
    """Write the checkpoint beside the old one and swap them, so that no moment is without a whole one."""
    lines = [asdict(epoch) for epoch in history]
    draft = work / f"{CHECKPOINT}.draft"
    state = [part.state_dict() for part in parts]
    torch.save({"settings": settings.identity(), "history": lines, "state": state}, draft)
    draft.replace(work / CHECKPOINT)
    (work / HISTORY).write_text(json.dumps({"settings": settings.identity(), "epochs": lines}, indent=1) + "\n")
