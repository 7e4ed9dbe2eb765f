"""Training of the small segmentation network: resumable, reproducible, on a CPU."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError
from slipguard.training.augment import Augment, TrainingFrames
from slipguard.training.small_network import SmallNet

WARM_UP_SHARE = 0.05
AVERAGE_HALF_LIFE_EPOCHS = 0.25
DICE_SMOOTHING_PX = 20.0
FALSE_CONTACT_PX = 40
"""Of 19,200: more contact in a frame without any is a false contact."""
WEIGHTS = "weights.pt"
"""In the work folder: the final weights, from which a later training can start."""


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """What determines a training, with the frames.

    patterns: random disturbances of each kind per epoch. bfloat16: convolutions in half precision, in half the time on
    a processor that supports it (AVX512-BF16, AMX), slower on others.
    """

    epochs: int = 6
    batch: int = 32
    rate: float = 3e-3
    seed: int = 0
    threads: int = 2
    threshold: float = 0.5
    patterns: int = 800
    bfloat16: bool = False


@dataclass(frozen=True, slots=True)
class EpochFigures:
    """loss: mean over the epoch; dice, iou: means over the held-out frames with contact; false_contact: share of those
    without that have more than `FALSE_CONTACT_PX` of contact.
    """

    epoch: int
    loss: float
    dice: float
    iou: float
    false_contact: float


def segmentation_loss(logits: Tensor, label: Tensor) -> Tensor:
    """Return twice the mean binary cross-entropy plus one minus the soft Dice of the samples with contact."""
    entropy = torch.nn.functional.binary_cross_entropy_with_logits(logits, label)
    probability = torch.sigmoid(logits)
    both = (probability * label).sum((1, 2, 3))
    total = (probability + label).sum((1, 2, 3))
    touching = (label.sum((1, 2, 3)) > 0).float()
    overlap = (2.0 * both + DICE_SMOOTHING_PX) / (total + DICE_SMOOTHING_PX)
    return 2.0 * entropy + ((1.0 - overlap) * touching).mean()


def train(
    frames: TrainingFrames,
    held_out: TrainingFrames,
    settings: TrainSettings,
    work: Path,
    on_step: Callable[[int, int], None],
    on_epoch: Callable[[EpochFigures, SmallNet], None],
    backgrounds: list[NDArray[np.uint8]] | None = None,
    start: Path | None = None,
) -> SmallNet:
    """Train and return the averaged network. Adam, one cycle of the rate, exponential average of the weights.

    Args:
        frames: Frames for training.
        held_out: Frames for the figures of each epoch.
        settings: What determines the training.
        work: Folder of the checkpoint and the final weights. A training resumes from its last whole epoch.
        on_step: Called with the number of finished and of all batches.
        on_epoch: Called with the figures and the average so far.
        backgrounds: Real background images (320, 240, 3) that half of the imprints are put on.
        start: Weights of an earlier training, to start with instead of random ones.

    Raises:
        InputError: There are fewer frames than one batch, or `start` holds other weights.
    """
    steps = len(frames) // settings.batch
    if steps < 1:
        raise InputError(f"{len(frames)} frames are fewer than one batch of {settings.batch}; use more frames")
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    net = SmallNet()
    if start is not None:
        load_weights(net, start)
    net.to(memory_format=torch.channels_last)  # type: ignore[call-overload, unused-ignore]
    keep = 0.5 ** (1.0 / max(AVERAGE_HALF_LIFE_EPOCHS * steps, 1.0))
    moving = get_ema_multi_avg_fn(keep)  # type: ignore[no-untyped-call, unused-ignore]
    average = AveragedModel(net, multi_avg_fn=moving, use_buffers=True)
    averaged = cast(SmallNet, average.module)
    optimizer = torch.optim.Adam(net.parameters(), settings.rate)
    total = settings.epochs * steps
    schedule = torch.optim.lr_scheduler.OneCycleLR(
        optimizer, settings.rate, max(total + 1, 10), pct_start=WARM_UP_SHARE, cycle_momentum=False
    )
    parts = (net, average, optimizer, schedule)
    identity = asdict(settings) | {"threads": 0, "frames": len(frames)}
    checkpoint = work / "checkpoint.pt"
    for epoch in range(_resume(checkpoint, identity, parts), settings.epochs):
        augment = Augment(settings.seed + 1000 * (epoch + 1), settings.patterns, backgrounds)
        order = np.random.default_rng([settings.seed, epoch]).permutation(len(frames))
        net.train()
        losses = 0.0
        for step in range(steps):
            batch = augment(frames.part(np.sort(order[step * settings.batch :][: settings.batch])))
            with torch.autocast("cpu", torch.bfloat16, enabled=settings.bfloat16):
                logits = net(batch.frame, batch.background, batch.known)
            loss = segmentation_loss(logits.float(), batch.label)
            optimizer.zero_grad()
            torch.autograd.backward(loss)
            optimizer.step()
            schedule.step()
            average.update_parameters(net)
            losses += float(loss.detach())
            on_step(epoch * steps + step + 1, total)
        figures = EpochFigures(epoch + 1, losses / steps, *scores(averaged, held_out, settings.threshold))
        on_epoch(figures, averaged)
        state = [part.state_dict() for part in parts]
        torch.save({"identity": identity, "epoch": epoch + 1, "state": state}, checkpoint)
    torch.save(averaged.state_dict(), work / WEIGHTS)
    averaged.eval()
    return averaged


def load_weights(net: SmallNet, path: Path) -> None:
    """Load all weights of a network. Raises InputError if the file cannot be read, lacks some or has others."""
    try:
        net.load_state_dict(torch.load(path, map_location="cpu", weights_only=True))
    except Exception as error:
        raise InputError(
            f"{path}: not the weights of this network; give the weights.pt of a training by this version of slipguard"
        ) from error


def _resume(path: Path, identity: dict[str, Any], parts: tuple[Any, ...]) -> int:
    """Load the parts' states if `path` belongs to this training; return the number of finished epochs."""
    saved = torch.load(path, weights_only=True) if path.is_file() else {}
    if saved.get("identity") != identity:
        return 0
    for part, state in zip(parts, saved["state"], strict=True):
        part.load_state_dict(state)
    return int(saved["epoch"])


def scores(net: SmallNet, frames: TrainingFrames, threshold: float) -> tuple[float, float, float]:
    """Return mean Dice and IoU over frames with contact, and the share of false contacts over those without."""
    net.eval()
    overlaps: list[tuple[float, float]] = []
    false_contacts: list[bool] = []
    for start in range(0, len(frames), 50):
        some = frames.part(slice(start, start + 50))
        with torch.no_grad():
            logits = net(*(torch.from_numpy(one.copy()) for one in (some.frame, some.background, some.known)))
        masks = torch.sigmoid(logits)[:, 0].numpy() > threshold
        for mask, truth in zip(masks, some.label > 127, strict=True):
            if truth.any():
                overlaps.append((dice(mask, truth), iou(mask, truth)))
            else:
                false_contacts.append(int(mask.sum()) > FALSE_CONTACT_PX)
    means = np.mean(overlaps, 0) if overlaps else (float("nan"), float("nan"))
    return float(means[0]), float(means[1]), float(np.mean(false_contacts)) if false_contacts else 0.0
