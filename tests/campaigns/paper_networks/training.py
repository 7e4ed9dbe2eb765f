"""Training of the paper's networks: resumable after every epoch, in mixed precision if the machine supports it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError
from tests.campaigns.paper_networks.frames import MaskedFrames
from tests.campaigns.paper_networks.networks import FrameNet
from tests.campaigns.paper_networks.recipe import FOCAL_GAMMA, Arch, Recipe, Schedule

WARM_UP_SHARE = 0.2
CHECKPOINT, HISTORY, WEIGHTS = "checkpoint.pt", "history.json", "weights.pt"


@dataclass(frozen=True, slots=True)
class PaperTraining:
    """What determines a training. encoder: source of the encoder's first weights, in words."""

    arch: Arch
    recipe: Recipe
    frames: int
    seed: int = 0
    encoder: str = "random"
    precision: str = "float32"

    def identity(self) -> dict[str, Any]:
        """Return plain values, to store with the result."""
        values: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return values


@dataclass(frozen=True, slots=True)
class PaperEpoch:
    """loss: mean focal loss; dice, iou: mean over held-out frames; seconds: time of the epoch with its validation."""

    number: int
    loss: float
    dice: float
    iou: float
    seconds: float


@dataclass(frozen=True, slots=True)
class TrainingPrecision:
    """Device and arithmetic. name: float32, or the shorter type of convolutions; weights stay in float32."""

    name: str
    device: torch.device
    scaler: Any
    """Scales losses so that float16 gradients do not vanish; does nothing for other types."""

    def autocast(self) -> AbstractContextManager[Any]:
        """Return the context to run the network in."""
        kind: torch.dtype = getattr(torch, self.name)
        return torch.autocast(self.device.type, kind, enabled=kind is not torch.float32)


def choose_precision(bfloat16: bool = False) -> TrainingPrecision:
    """Return the GPU if there is one, in bfloat16 if supported, else float16; otherwise the CPU, in float32.

    Args:
        bfloat16: Use it on a CPU: with AVX512-BF16 or AMX it halves the time, without them it multiplies the time.
    """
    gpu = torch.cuda.is_available()
    if gpu:
        name = "bfloat16" if torch.cuda.is_bf16_supported(including_emulation=False) else "float16"
    else:
        name = "bfloat16" if bfloat16 else "float32"
    device = torch.device("cuda" if gpu else "cpu")
    return TrainingPrecision(name, device, torch.amp.GradScaler(device.type, enabled=name == "float16"))


def focal_loss(logits: Tensor, target: Tensor) -> Tensor:
    """Return the mean over pixels of (1 - p)^2 times the cross-entropy, p the probability of the true class.

    Source: T.-Y. Lin et al., "Focal loss for dense object detection", ICCV 2017.
    """
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(logits, target, reduction="none")
    return ((1.0 - torch.exp(-entropy)) ** FOCAL_GAMMA * entropy).mean()


def train(
    net: FrameNet,
    settings: PaperTraining,
    precision: TrainingPrecision,
    shown: MaskedFrames,
    held_out: MaskedFrames,
    work: Path,
    on_step: Callable[[int, int], None],
    on_epoch: Callable[[PaperEpoch], None],
) -> list[PaperEpoch]:
    """Train `net` in place and return the figures of all epochs.

    Args:
        net: The network.
        settings: What determines the training.
        precision: Device and arithmetic.
        shown: Frames for training.
        held_out: Frames for validation.
        work: Folder for checkpoint, history (JSON) and final weights. A training resumes from its last whole epoch.
        on_step: Called with the number of finished and of all batches.
        on_epoch: Called after every epoch.

    Raises:
        InputError: There are fewer frames than a batch, or `work` contains another training.
    """
    recipe = settings.recipe
    steps = len(shown) // recipe.batch
    if steps < 1:
        raise InputError(
            f"{len(shown)} frames are fewer than a batch of {recipe.batch}; use more frames or a smaller --batch"
        )
    on_device: Any = net.to(precision.device)
    on_device.to(memory_format=torch.channels_last)
    total = recipe.epochs * steps
    optimizer = torch.optim.Adam(net.parameters(), recipe.rate)
    schedule = _schedule(optimizer, recipe, total)
    parts = (net, optimizer, schedule, precision.scaler)
    history = _resume(work / CHECKPOINT, settings, parts)
    on_step(len(history) * steps, total)
    for number in range(len(history) + 1, recipe.epochs + 1):
        start_s = time.monotonic()
        rng = np.random.default_rng([settings.seed, number])
        torch.manual_seed(int(rng.integers(2**31)))  # dropout: a resumed epoch equals an uninterrupted one
        order = rng.permutation(len(shown))
        net.train()
        losses = 0.0
        for step in range(steps):
            frame, target = _batch(shown, order[step * recipe.batch :][: recipe.batch], recipe.mirrored, rng)
            with precision.autocast():
                logits = net(frame.to(precision.device, non_blocking=True))
            loss = focal_loss(logits.float(), target.to(precision.device, non_blocking=True))
            optimizer.zero_grad(set_to_none=True)
            torch.autograd.backward(precision.scaler.scale(loss))
            precision.scaler.step(optimizer)
            precision.scaler.update()
            schedule.step()
            losses += float(loss.detach())
            on_step((number - 1) * steps + step + 1, total)
        mean_dice, mean_iou = np.mean(overlaps(net, precision, held_out), 0)
        seconds = time.monotonic() - start_s
        history.append(PaperEpoch(number, losses / steps, float(mean_dice), float(mean_iou), seconds))
        _save_checkpoint(work, settings, parts, history)
        on_epoch(history[-1])
    torch.save({name: value.cpu() for name, value in net.state_dict().items()}, work / WEIGHTS)
    return history


def overlaps(
    net: FrameNet, precision: TrainingPrecision, frames: MaskedFrames, threshold: float = 0.5
) -> list[list[float]]:
    """Return [Dice, IoU] of every frame."""
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


def _schedule(optimizer: torch.optim.Optimizer, recipe: Recipe, total: int) -> Any:
    if recipe.schedule is Schedule.constant:
        return torch.optim.lr_scheduler.ConstantLR(optimizer, 1.0, 0)
    steps = max(total + 1, 10)  # fewer leave no step for the increase
    return torch.optim.lr_scheduler.OneCycleLR(
        optimizer, recipe.rate, total_steps=steps, pct_start=WARM_UP_SHARE, cycle_momentum=False
    )


def _batch(
    frames: MaskedFrames, pick: NDArray[np.int64], mirrored: bool, rng: np.random.Generator
) -> tuple[Tensor, Tensor]:
    """Return frames (N, H, W, 3) uint8 and their masks (N, 1, H, W) float, 0 or 1."""
    pick = np.sort(pick)
    frame, mask = frames.frame[pick], frames.mask[pick]
    if mirrored:
        for axis in (1, 2):
            mirrored_now = rng.random(len(pick)) < 0.5
            for array in (frame, mask):
                array[mirrored_now] = np.flip(array[mirrored_now], axis)
    return torch.from_numpy(np.asarray(frame)), torch.from_numpy((np.asarray(mask)[:, None] > 127).astype(np.float32))


def _resume(path: Path, settings: PaperTraining, parts: tuple[Any, ...]) -> list[PaperEpoch]:
    if not path.is_file():
        return []
    try:
        saved = torch.load(path, map_location="cpu", weights_only=True)
        expected, found = settings.identity(), saved["settings"]
    except Exception as error:
        raise InputError(f"{path}: not a checkpoint of this command; remove it or set another --work") from error
    if found != expected:
        other = next(key for key in expected if found.get(key) != expected[key])
        raise InputError(
            f"{path.parent} holds a training with {other} {found.get(other)}, not {expected[other]}; "
            "set another --work or remove it"
        )
    for part, state in zip(parts, saved["state"], strict=True):
        part.load_state_dict(state)
    return [PaperEpoch(**line) for line in saved["history"]]


def _save_checkpoint(work: Path, settings: PaperTraining, parts: tuple[Any, ...], history: list[PaperEpoch]) -> None:
    """Write the checkpoint to a draft and rename it, so that there is a complete one at any time."""
    lines = [asdict(epoch) for epoch in history]
    draft = work / f"{CHECKPOINT}.draft"
    state = [part.state_dict() for part in parts]
    torch.save({"settings": settings.identity(), "history": lines, "state": state}, draft)
    draft.replace(work / CHECKPOINT)
    (work / HISTORY).write_text(json.dumps({"settings": settings.identity(), "epochs": lines}, indent=1) + "\n")
