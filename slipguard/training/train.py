"""Training of the small segmentation network on rendered frames: resumable, reproducible, on a CPU."""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from slipguard.datasets.frame_cache import TrainingFrames
from slipguard.datasets.mask_scores import dice, iou
from slipguard.errors import InputError
from slipguard.perception.background import estimate_background
from slipguard.perception.segmenter import INPUT_HEIGHT_PX, INPUT_WIDTH_PX
from slipguard.training.augment import Augment
from slipguard.training.small_network import SmallNet

WARM_UP_SHARE = 0.05
EMA_HALF_LIFE_EPOCHS = 0.25
DICE_SMOOTHING_PX = 20.0
WEIGHTS = "weights.pt"
"""In the work folder: the final weights, from which a later training can start."""


@dataclass(frozen=True, slots=True)
class TrainSettings:
    """What determines a training, with the frames.

    unknown: share of samples with an estimated background image. contrast_max: strongest imprint, relative to the
    rendered one. zoom_share: share of samples enlarged to broad bulges. bfloat16: convolutions in half precision, in
    half the time on a processor that supports it (AVX512-BF16, AMX), slower on others.
    """

    epochs: int = 6
    batch: int = 32
    rate: float = 3e-3
    seed: int = 0
    threads: int = 2
    threshold: float = 0.5
    patterns: int = 800
    """Random disturbances of each kind per epoch."""
    unknown: float = 0.3
    contrast_max: float = 2.0
    zoom_share: float = 0.2
    bfloat16: bool = False


@dataclass(frozen=True, slots=True)
class EpochFigures:
    """loss: mean over the epoch; dice, iou: means over rendered validation frames with contact;
    false_contact: share of validation frames without contact that have more than 40 of 19,200 pixels of contact.
    """

    epoch: int
    loss: float
    dice: float
    iou: float
    false_contact: float


FALSE_CONTACT_PX = 40


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
    validation: TrainingFrames,
    settings: TrainSettings,
    work: Path,
    on_step: Callable[[int, int], None],
    on_epoch: Callable[[EpochFigures, SmallNet], None],
    backgrounds: list[NDArray[np.uint8]] | None = None,
    start: Path | None = None,
    make_net: Callable[[], SmallNet] = SmallNet,
) -> SmallNet:
    """Train and return the averaged network. Adam, linear warm-up, cosine decay to zero, exponential average.

    Args:
        frames: Frames for training.
        validation: Frames for the figures of each epoch.
        settings: What determines the training.
        work: Folder of the checkpoint and the final weights. A training resumes from its last whole epoch.
        on_step: Called with the number of finished and of all batches.
        on_epoch: Called with the figures and the average so far.
        backgrounds: Real background images (320, 240, 3) that half of the imprints are put on.
        start: Weights of an earlier training of the same network, to start with instead of random ones.
        make_net: Makes the network.

    Raises:
        InputError: There are fewer frames than one batch, or `start` holds other weights.
    """
    steps_per_epoch = len(frames) // settings.batch
    if steps_per_epoch < 1:
        raise InputError(f"{len(frames)} frames are fewer than one batch of {settings.batch}; use more frames")
    torch.set_num_threads(settings.threads)
    torch.manual_seed(settings.seed)
    net = make_net()
    if start is not None:
        _load_weights(net, start)
    _channels_last(net)
    average = copy.deepcopy(net)
    total = settings.epochs * steps_per_epoch
    optimizer = torch.optim.Adam(net.parameters(), settings.rate)
    schedule = torch.optim.lr_scheduler.LambdaLR(optimizer, partial(_rate_share, total=total))
    checkpoint = work / "checkpoint.pt"
    done_epochs = _resume(checkpoint, settings, len(frames), net, average, optimizer, schedule)
    keep = 0.5 ** (1.0 / max(EMA_HALF_LIFE_EPOCHS * steps_per_epoch, 1.0))
    for epoch in range(done_epochs, settings.epochs):
        augment = _augment(frames, settings, epoch, backgrounds)
        order = np.random.default_rng([settings.seed, epoch]).permutation(len(frames))
        net.train()
        losses = 0.0
        for step in range(steps_per_epoch):
            pick = np.sort(order[step * settings.batch : (step + 1) * settings.batch])
            batch = augment(*(torch.from_numpy(a[pick]) for a in (frames.frame, frames.background, frames.label)))
            with torch.autocast("cpu", torch.bfloat16, enabled=settings.bfloat16):
                logits = net(batch.frame, batch.background, batch.known)
            loss = segmentation_loss(logits.float(), batch.label)
            optimizer.zero_grad()
            torch.autograd.backward(loss)
            optimizer.step()
            schedule.step()
            losses += float(loss.detach())
            done = epoch * steps_per_epoch + step + 1
            _average_into(average, net, min(keep, done / (done + 10.0)))
            on_step(done, total)
        scores = rendered_scores(average, validation, settings.threshold)
        on_epoch(EpochFigures(epoch + 1, losses / steps_per_epoch, *scores), average)
        state = [part.state_dict() for part in (net, average, optimizer, schedule)]
        torch.save(
            {"settings": asdict(settings), "frames": len(frames), "epoch": epoch + 1, "state": state}, checkpoint
        )
    torch.save(average.state_dict(), work / WEIGHTS)
    average.eval()
    return average


def _augment(
    frames: TrainingFrames, settings: TrainSettings, epoch: int, backgrounds: list[NDArray[np.uint8]] | None
) -> Augment:
    height, width = frames.label.shape[1:]
    return Augment(
        settings.seed + 1000 * (epoch + 1),
        settings.patterns,
        settings.unknown,
        settings.contrast_max,
        backgrounds,
        settings.zoom_share,
        (width, height),
    )


def _channels_last(net: SmallNet) -> None:
    """Store weights in the memory order in which a CPU convolves fastest."""
    for weights in net.parameters():
        if weights.ndim == 4:
            weights.data = weights.data.contiguous(memory_format=torch.channels_last)


def _load_weights(net: SmallNet, path: Path) -> None:
    """Load all weights of a network. Raises InputError if the file lacks some or has others."""
    advice = "give the weights.pt of a training by this version of slipguard"
    try:
        weights = dict(torch.load(path, map_location="cpu", weights_only=True))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); {advice}") from error
    except Exception as error:
        raise InputError(f"{path}: not a file of weights; {advice}") from error
    own = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    found = {name: tuple(getattr(value, "shape", ())) for name, value in weights.items()}
    wrong = sorted(name for name in own.keys() | found.keys() if own.get(name) != found.get(name))
    if wrong:
        missing = len(own.keys() - found.keys())
        raise InputError(
            f"{path}: weights of another network ({len(wrong)} of {len(own)} tensors differ, {missing} are missing, "
            f"first {wrong[0]}); {advice}"
        )
    net.load_state_dict(weights)


def _rate_share(step: int, total: int) -> float:
    warm = max(WARM_UP_SHARE * total, 1.0)
    if step < warm:
        return (step + 1) / warm
    return 0.5 * (1.0 + math.cos(math.pi * min((step - warm) / max(total - warm, 1.0), 1.0))) + 1e-3


def _average_into(average: SmallNet, net: SmallNet, keep: float) -> None:
    with torch.no_grad():
        for mean, now in zip(average.state_dict().values(), net.state_dict().values(), strict=True):
            if mean.dtype.is_floating_point:
                mean.mul_(keep).add_(now, alpha=1.0 - keep)
            else:
                mean.copy_(now)


def _resume(path: Path, settings: TrainSettings, count: int, *parts: Any) -> int:
    """Load the parts' states if `path` belongs to these settings; return the number of finished epochs."""
    if not path.is_file():
        return 0
    saved = torch.load(path, weights_only=True)
    expected = asdict(settings) | {"threads": saved["settings"]["threads"]}
    if saved["settings"] != expected or saved["frames"] != count:
        return 0
    for part, state in zip(parts, saved["state"], strict=True):
        part.load_state_dict(state)
    return int(saved["epoch"])


def probabilities(net: SmallNet, frame: NDArray[np.uint8], background: NDArray[np.uint8], known: bool) -> Tensor:
    """Return contact probabilities (N, 160, 120) of images at network resolution, (N, 160, 120, 3) uint8."""
    net.eval()
    with torch.no_grad():
        flags = torch.full((len(frame),), float(known))
        logits = net(torch.from_numpy(frame.copy()), torch.from_numpy(background.copy()), flags)
    return torch.sigmoid(logits)[:, 0]


def rendered_scores(net: SmallNet, frames: TrainingFrames, threshold: float) -> tuple[float, float, float]:
    """Return mean Dice and IoU over frames with contact, and the share of false contacts over those without."""
    overlaps: list[tuple[float, float]] = []
    false_contacts: list[bool] = []
    for start in range(0, len(frames), 50):
        part = slice(start, start + 50)
        masks = probabilities(net, frames.frame[part], frames.background[part], True).numpy() > threshold
        for mask, truth in zip(masks, frames.label[part] > 127, strict=True):
            if truth.any():
                overlaps.append((dice(mask, truth), iou(mask, truth)))
            else:
                false_contacts.append(int(mask.sum()) > FALSE_CONTACT_PX)
    means = np.mean(overlaps, 0) if overlaps else (float("nan"), float("nan"))
    return float(means[0]), float(means[1]), float(np.mean(false_contacts)) if false_contacts else 0.0


def frame_iou(
    net: SmallNet,
    image: NDArray[np.uint8],
    background: NDArray[np.uint8] | None,
    mask: NDArray[np.bool_],
    threshold: float,
    size: tuple[int, int] = (INPUT_WIDTH_PX, INPUT_HEIGHT_PX),
) -> float:
    """Return the IoU of a frame's segmented contact with its label, at the label's size.

    Without a background image it is estimated from the frame. size: (width, height) of the network's input.
    """
    small = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), np.uint8)
    if background is None:
        shown = estimate_background(small)
    else:
        shown = np.asarray(cv2.resize(background, size, interpolation=cv2.INTER_AREA), np.uint8)
    probability = probabilities(net, small[None], shown[None], background is not None)[0].numpy()
    return iou(np.asarray(cv2.resize(probability, mask.shape[::-1]) > threshold), mask)
