"""What a lift's recording holds, put on one clock: seconds on the loop's, as the tactile frames have them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from slipguard.config_errors import first_complaint
from slipguard.errors import InputError
from slipguard.evaluation.intrinsics import Intrinsics
from slipguard.evaluation.lift_file import INTRINSICS_ATTACHMENT, LIFT_ATTACHMENT
from slipguard.recording import messages as m
from slipguard.recording.reader import Recording, StoredImage, open_recording


class LiftDescription(BaseModel):
    """What was lifted and how; see `Protocol`."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    protocol: str
    object: str
    seen: bool
    hard: str
    repeat: int
    number: int
    guard: bool
    marker_side_mm: float
    camera_side: str
    camera_lag_s: float | None = None


@dataclass(frozen=True, slots=True, eq=False)
class TimedImage:
    """A compressed picture and its time stamp."""

    time_s: float
    picture: StoredImage


@dataclass(frozen=True, slots=True, eq=False)
class FingerFrame:
    """A frame of a finger with what was made of it; the picture is None where none was recorded."""

    judged: m.FrameRecord
    picture: StoredImage | None


@dataclass(slots=True, eq=False)
class LiftData:
    """One lift. fused: (time of capture, turn, sigma), each frame once. phases: (time, name)."""

    path: Path
    about: LiftDescription
    intrinsics: Intrinsics
    recording: Recording
    camera: list[TimedImage] = field(default_factory=list)
    fingers: dict[str, list[FingerFrame]] = field(default_factory=lambda: {name: [] for name in m.FINGERS})
    masks: dict[str, list[TimedImage]] = field(default_factory=lambda: {name: [] for name in m.FINGERS})
    true_masks: dict[str, list[TimedImage]] = field(default_factory=lambda: {name: [] for name in m.FINGERS})
    fused: list[tuple[float, float, float]] = field(default_factory=list)
    declined: int = 0
    """Turns of the loop while the object was held that had no turn to go by."""
    held: int = 0
    phases: list[tuple[float, str]] = field(default_factory=list)
    truth: list[m.TruthRecord] = field(default_factory=list)

    def phase_began_s(self, name: str) -> float | None:
        """When a phase was entered first."""
        return next((at_s for at_s, phase in self.phases if phase == name), None)

    def true_rotations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Times and turns, empty on a real cell."""
        return np.array([one.now_s for one in self.truth]), np.array([one.rotation_deg for one in self.truth])


A = TypeVar("A", bound=BaseModel)
HELD = frozenset({"reference", "holding", "lifting"})


def read_lift(path: Path) -> LiftData:
    """Read one lift. Raises InputError for what is none, or is cut off before the lift."""
    recording = open_recording(path)
    data = LiftData(path, _about(recording), _intrinsics(recording), recording)
    offset_s: float | None = None
    pending: dict[str, StoredImage] = {}
    timed: list[tuple[list[TimedImage], int, StoredImage]] = []
    for item in recording.items():
        value = item.value
        if isinstance(value, m.CycleRecord):
            offset_s = 1e-9 * item.at_ns - value.now_s
            _take_tick(data, value)
        elif isinstance(value, m.TruthRecord):
            data.truth.append(value)
        elif isinstance(value, m.FrameRecord):
            finger = item.topic.split("/")[1]
            data.fingers[finger].append(FingerFrame(value, pending.pop(finger, None)))
        elif isinstance(value, StoredImage):
            home = _home(data, item.topic)
            if home is None:
                pending[value.source] = value
            else:
                timed.append((home, item.at_ns, value))
    began_s = data.phase_began_s("lifting")
    if offset_s is None or began_s is None:
        why = f"; it {recording.damage}" if recording.damage else ""
        raise InputError(f"{path}: no lift is in it{why}")
    if recording.damage is not None and data.phases[-1][1] == "lifting":
        raise InputError(f"{path}: {recording.damage}, in the middle of the lift; do that lift again")
    for home, at_ns, picture in timed:
        home.append(TimedImage(1e-9 * at_ns - offset_s, picture))
    return data


def _home(data: LiftData, topic: str) -> list[TimedImage] | None:
    """Where a picture belongs; None for a finger's image, which goes with the judgement that follows it."""
    if topic == m.IMAGE_TOPIC[m.CAMERA]:
        return data.camera
    for topics, homes in ((m.MASK_TOPIC, data.masks), (m.TRUE_MASK_TOPIC, data.true_masks)):
        for finger, name in topics.items():
            if topic == name:
                return homes[finger]
    return None


def _take_tick(data: LiftData, tick: m.CycleRecord) -> None:
    if not data.phases or data.phases[-1][1] != tick.phase:
        data.phases.append((tick.now_s, tick.phase))
    if tick.phase not in HELD or tick.phase == "reference":
        return
    fused = tick.observation.fused
    data.held += 1
    if fused is None or fused.rotation_deg is None or fused.sigma_deg is None:
        data.declined += 1
    elif not data.fused or fused.captured_at_s > data.fused[-1][0]:
        data.fused.append((fused.captured_at_s, fused.rotation_deg, fused.sigma_deg))


def _about(recording: Recording) -> LiftDescription:
    return _attached(recording, LIFT_ATTACHMENT, LiftDescription)


def _intrinsics(recording: Recording) -> Intrinsics:
    return _attached(recording, INTRINSICS_ATTACHMENT, Intrinsics)


def _attached(recording: Recording, name: str, kind: type[A]) -> A:
    content = recording.attachments.get(name)
    if content is None:
        raise InputError(f"{recording.path}: no {name} in it; it was not made by `slipguard evaluate run`")
    try:
        return kind.model_validate(json.loads(content))
    except ValidationError as error:
        raise InputError(f"{recording.path}: {name}: {first_complaint(error, kind)}") from None
    except ValueError as error:
        raise InputError(f"{recording.path}: {name}: {error}") from None


def lift_paths(folder: Path) -> Iterator[Path]:
    """The recordings of an experiment in order."""
    yield from sorted((folder / "lifts").glob("*.mcap"))
