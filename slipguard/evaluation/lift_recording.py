"""One lift, one MCAP file: the daemon's recording, the external camera, and the truth of a simulated world."""

from __future__ import annotations

import asyncio
import contextlib
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Literal, Self, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, ValidationError

from slipguard.config_errors import describe_validation_error
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.recording import RecordingObserver, header, observed
from slipguard.devices import FINGERS
from slipguard.errors import InputError, SlipguardError
from slipguard.evaluation.camera_calibration import Intrinsics
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.recording import messages as m
from slipguard.recording.reader import Recording, StoredImage, open_recording
from slipguard.recording.recorder import RecordedCycle, RecordedFrame, RecordedMessage, RecorderSettings, write_frame
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader

CAMERA_QUALITY = 88
FINGER_SETTINGS = RecorderSettings("jpeg", 95)
PART = ".part"
LIFT_ATTACHMENT = "lift.json"
INTRINSICS_ATTACHMENT = "intrinsics.json"
M = TypeVar("M", bound=BaseModel)


class LiftDescription(BaseModel):
    """The lift that a file holds; see `LiftProtocol`. camera_lag_s: true lag of a rendered camera, None on a cell."""

    model_config = ConfigDict(frozen=True, extra="ignore", allow_inf_nan=False)

    protocol: str
    object: str
    seen: bool
    hard: str
    repeat: int
    number: int
    guard: bool
    marker_side_mm: float
    camera_side: Literal["left", "right"]
    camera_lag_s: float | None = None


class LiftRecorder:
    """Records a service into `path` while it is entered; the file gets its name when it is complete.

    Values are written at once: an experiment may cost some milliseconds more than the daemon. A disk error never
    disturbs the caller, because an object may be in the air: writing stops, and leaving raises SlipguardError.
    """

    records_images = True

    def __init__(
        self,
        path: Path,
        service: Service,
        protocol: LiftProtocol,
        lift: PlannedLift,
        intrinsics: Intrinsics,
        true_lag_s: float | None,
    ) -> None:
        self._path, self._service = path, service
        about = LiftDescription(
            protocol=protocol.name,
            object=lift.item.name,
            seen=lift.item.seen,
            hard=lift.item.hard,
            repeat=lift.repeat,
            number=lift.number,
            guard=protocol.guard,
            marker_side_mm=protocol.marker_side_mm,
            camera_side=protocol.camera_side,
            camera_lag_s=true_lag_s,
        )
        self._attachments = {
            LIFT_ATTACHMENT: about.model_dump_json(indent=1).encode(),
            INTRINSICS_ATTACHMENT: intrinsics.model_dump_json(indent=1).encode(),
        }
        self._file: RecordingFile | None = None
        self._broken: OSError | None = None
        self._part = path.with_name(path.name + PART)
        self._clock = RecordingClock(time.time_ns(), asyncio.get_running_loop().time())
        self._attached = contextlib.ExitStack()

    def __enter__(self) -> Self:
        with contextlib.suppress(OSError):
            self._part.unlink()
        self._attached.enter_context(observed(self._service, RecordingObserver(self)))
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._attached.close()
        file, self._file = self._file, None  # the camera's thread may still deliver an image
        if error is None and self._broken is None and file is not None:
            try:
                file.close()
                self._part.replace(self._path)
                return
            except OSError as broken:
                self._broken = broken
        with contextlib.suppress(OSError):
            if file is not None:
                file.abandon()
            self._part.unlink(missing_ok=True)
        if error is None and self._broken is not None:
            why = self._broken.strerror or self._broken
            raise SlipguardError(f"{self._path}: not recorded ({why}); free disk space, then start again")

    def add(self, value: RecordedFrame | RecordedCycle | RecordedMessage) -> None:
        if isinstance(value, RecordedCycle):
            self._write(lambda file: file.cycle(value.record), first=value)
        elif isinstance(value, RecordedFrame):
            self._write(lambda file: write_frame(file, value, FINGER_SETTINGS))

    def camera(self, at_s: float, jpeg: bytes) -> None:
        """Write an image of the external camera; at_s: its time stamp on the loop's clock."""
        self._write(lambda file: file.image(m.CAMERA, at_s, jpeg, "jpeg"))

    def truth(self, truth: m.TruthRecord) -> None:
        self._write(lambda file: file.truth(truth))

    def true_mask(self, finger: str, at_s: float, mask: NDArray[np.uint8]) -> None:
        """Write the true contact mask at a time, (320, 240), 0 or 1."""
        png = cv2.imencode(".png", mask * np.uint8(255))[1].tobytes()
        self._write(lambda file: file.true_mask(finger, at_s, png))

    def _write(self, what: Callable[[RecordingFile], None], first: RecordedCycle | None = None) -> None:
        """Write, unless no cycle has started the file yet or the disk has failed."""
        if self._broken is not None:
            return
        try:
            if self._file is None and first is not None:
                plain = header(self._service)
                about = RecordingHeader(plain.facts, {**plain.attachments, **self._attachments})
                self._file = RecordingFile(self._part, self._clock, about, first.memory, first.record.now_s)
            if self._file is not None:
                what(self._file)
        except OSError as error:
            self._broken = error


def encode_jpeg(image: NDArray[np.uint8]) -> bytes:
    return cv2.imencode(".jpg", image, [cv2.IMWRITE_JPEG_QUALITY, CAMERA_QUALITY])[1].tobytes()


@dataclass(frozen=True, slots=True, eq=False)
class TimedImage:
    """A compressed image and its time stamp."""

    time_s: float
    image: StoredImage


@dataclass(frozen=True, slots=True, eq=False)
class LiftFrame:
    """A finger's frame record; image: None if none was recorded."""

    record: m.FrameRecord
    image: StoredImage | None


@dataclass(slots=True, eq=False)
class LiftData:
    """One lift on one clock: seconds on the loop's, as the tactile frames have them.

    Attributes:
        fused: (capture time, rotation, sigma) of each fused estimate, once.
        declined: cycles without an estimate while the object was held.
        held: cycles while the object was held.
        phases: (time, name).
    """

    path: Path
    about: LiftDescription
    intrinsics: Intrinsics
    recording: Recording
    camera: list[TimedImage] = field(default_factory=list)
    fingers: dict[str, list[LiftFrame]] = field(default_factory=lambda: {name: [] for name in FINGERS})
    masks: dict[str, list[TimedImage]] = field(default_factory=lambda: {name: [] for name in FINGERS})
    true_masks: dict[str, list[TimedImage]] = field(default_factory=lambda: {name: [] for name in FINGERS})
    fused: list[tuple[float, float, float]] = field(default_factory=list)
    declined: int = 0
    held: int = 0
    phases: list[tuple[float, str]] = field(default_factory=list)
    truth: list[m.TruthRecord] = field(default_factory=list)

    def phase_began_s(self, name: str) -> float | None:
        return next((at_s for at_s, phase in self.phases if phase == name), None)

    def true_rotations(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Return times and true rotations, empty on a real cell."""
        return np.array([one.now_s for one in self.truth]), np.array([one.rotation_deg for one in self.truth])


def read_lift(path: Path) -> LiftData:
    """Return one lift. Raises InputError for another file, or one truncated before or during the lift."""
    recording = open_recording(path)
    about = _attachment(recording, LIFT_ATTACHMENT, LiftDescription)
    data = LiftData(path, about, _attachment(recording, INTRINSICS_ATTACHMENT, Intrinsics), recording)
    lists = {m.IMAGE_TOPIC[m.CAMERA]: data.camera}
    lists |= {topic: data.masks[finger] for finger, topic in m.MASK_TOPIC.items()}
    lists |= {topic: data.true_masks[finger] for finger, topic in m.TRUE_MASK_TOPIC.items()}
    offset_s: float | None = None
    pending: dict[str, StoredImage] = {}  # a finger's image precedes its frame record
    timed: list[tuple[list[TimedImage], int, StoredImage]] = []
    for item in recording.items():
        value = item.value
        if isinstance(value, m.CycleRecord):
            offset_s = 1e-9 * item.at_ns - value.now_s
            _add_cycle(data, value)
        elif isinstance(value, m.TruthRecord):
            data.truth.append(value)
        elif isinstance(value, m.FrameRecord):
            finger = item.topic.split("/")[1]
            data.fingers[finger].append(LiftFrame(value, pending.pop(finger, None)))
        elif isinstance(value, StoredImage):
            if item.topic in lists:
                timed.append((lists[item.topic], item.at_ns, value))
            else:
                pending[value.source] = value
    if offset_s is None or data.phase_began_s("lifting") is None:
        why = f"; it {recording.damage}" if recording.damage else ""
        raise InputError(f"{path}: contains no lift{why}")
    if recording.damage is not None and data.phases[-1][1] == "lifting":
        raise InputError(f"{path}: {recording.damage}, during the lift; repeat this lift")
    for images, at_ns, image in timed:
        images.append(TimedImage(1e-9 * at_ns - offset_s, image))
    return data


def _add_cycle(data: LiftData, cycle: m.CycleRecord) -> None:
    if not data.phases or data.phases[-1][1] != cycle.phase:
        data.phases.append((cycle.now_s, cycle.phase))
    if cycle.phase not in ("holding", "lifting"):
        return
    fused = cycle.observation.fused
    data.held += 1
    if fused is None or fused.rotation_deg is None or fused.sigma_deg is None:
        data.declined += 1
    elif not data.fused or fused.captured_at_s > data.fused[-1][0]:
        data.fused.append((fused.captured_at_s, fused.rotation_deg, fused.sigma_deg))


def _attachment(recording: Recording, name: str, kind: type[M]) -> M:
    content = recording.attachments.get(name)
    if content is None:
        raise InputError(f"{recording.path}: no {name} in it; it was not made by `slipguard evaluate run`")
    try:
        return kind.model_validate_json(content)
    except ValidationError as error:
        raise InputError(f"{recording.path}: {name}: {describe_validation_error(error, kind)}") from None


def lift_paths(folder: Path) -> Iterator[Path]:
    yield from sorted((folder / "lifts").glob("*.mcap"))
