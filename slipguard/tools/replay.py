"""Replay of a recording: the same frames through the pipeline, the same observations through the controller.

The controller runs twice: on the recorded estimates, which must give exactly the recorded commands, and, if there are
images, on the pipeline's new estimates. A finger's pipeline starts at the first new reference. If the first file takes
none, for it is a later part of a recording, the files before it in its folder are processed from the last reference on,
without being counted. Nothing moves in a replay: after the first difference the recorded world no
longer responds to the commands, so only the first difference counts.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import Field, TypeAdapter, ValidationError

from slipguard.config_errors import describe_validation_error
from slipguard.control.control_step import ControlState, control_step
from slipguard.control.finger_fusion import fuse
from slipguard.control.messages import StepOutput
from slipguard.control.params import GuardParams
from slipguard.devices import FINGERS, Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import OTHER_FINGER, repeat_estimate
from slipguard.recording import messages as m
from slipguard.recording.reader import RecordedItem, Recording, StoredImage, decode_stored, open_recording
from slipguard.recording.ring import SUFFIX

SHOWN_MAX = 1000
"""Phases, faults and differences that are kept; a recording may hold any number of control steps."""
_Level = Annotated[float, Field(ge=0.0, le=255.0)]
_NOISE = TypeAdapter(tuple[_Level, _Level, _Level])
PART_GAP_S = 1.0
"""Longest time from the last frame of a file to the first frame of the next part of the recording."""
KEPT_ESTIMATES = 64
"""Estimates kept per finger; the loop uses none older than 150 ms."""


@dataclass(frozen=True, slots=True)
class CommandDifference:
    """A command that differs between recording and replay."""

    now_s: float
    recorded: StepOutput
    replayed: StepOutput


@dataclass(slots=True)
class ControllerReplay:
    """Number of control steps and of commands that differ; the first `SHOWN_MAX` of these."""

    ticks: int = 0
    differ: int = 0
    differences: list[CommandDifference] = field(default_factory=list)


@dataclass(slots=True)
class EstimateReplay:
    """What the pipeline's new estimates are, against the recorded ones.

    frames: all in the recordings. processed: those that the pipeline processed again. differ: those of them whose
    estimate differs, even in the last bit. rotation_difference_max_deg: where neither estimate was declined; None if
    there is no such frame.
    """

    frames: int = 0
    processed: int = 0
    differ: int = 0
    rotation_difference_max_deg: float | None = None

    def add(self, recorded: Estimate | None, replayed: Estimate | None) -> None:
        """Add a frame. replayed: None if it was not processed again."""
        self.frames += 1
        if replayed is None:
            return
        self.processed += 1
        self.differ += _plain(recorded) != _plain(replayed)
        then, now = _rotation(recorded), _rotation(replayed)
        if then is not None and now is not None:
            self.rotation_difference_max_deg = max(self.rotation_difference_max_deg or 0.0, abs(now - then))


@dataclass(slots=True)
class ReplayResult:
    """Result of a replay. on_recorded: with the recorded estimates. on_frames: with the pipeline's new estimates.

    phases and faults: the first `SHOWN_MAX`.
    """

    on_recorded: ControllerReplay = field(default_factory=ControllerReplay)
    on_frames: ControllerReplay = field(default_factory=ControllerReplay)
    estimates: EstimateReplay = field(default_factory=EstimateReplay)
    phases: list[tuple[float, str]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    image: str = "none"


def recordings(paths: Iterable[Path]) -> list[Recording]:
    """Open files, or all recordings of a folder sorted by name. Raises InputError."""
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
        if not found:
            raise InputError(f"{path}: no {SUFFIX} files in this folder. Name a folder with recordings")
        files += found
    return [open_recording(file) for file in files]


def replay(opened: list[Recording], model: Path | None = None) -> ReplayResult:
    """Replay recordings one after the other; each starts with the recorded state of the controller.

    Raises ModelError if the model cannot be loaded, even if no frame needs it.
    """
    player, done = _RecordingPlayer(Segmenter(model)), ReplayResult()
    for recording in parts_since_reference(opened[0]) if opened else []:
        player.play(recording, ReplayResult())
    for recording in opened:
        done.image = "none"
        player.play(recording, done)
        if recording.damage is not None:
            done.damage.append(f"{recording.path.name} {recording.damage}")
    return done


def parts_since_reference(first: Recording) -> list[Recording]:
    """Return the files before a file that takes no reference, from the last one that does; none if there is none."""
    if _takes_reference(first):
        return []
    found: list[Recording] = []
    for path in sorted(first.path.parent.glob(f"*{SUFFIX}"), reverse=True):
        if path.name >= first.path.name:
            continue
        try:
            found.insert(0, open_recording(path))
        except InputError:
            return []
        if not _same_header(found[0], first):
            return []
        if _takes_reference(found[0]):
            return found
    return []


def _takes_reference(recording: Recording) -> bool:
    return any(isinstance(item.value, m.FrameRecord) and item.value.new_reference for item in recording.items())


def _same_header(one: Recording, other: Recording) -> bool:
    return one.facts == other.facts and one.attachments == other.attachments


class _RecordingPlayer:
    """Plays files, one after the other, each into a `ReplayResult`.

    A finger is live while its pipeline has received every frame since its reference, also across the files of one
    recording. renewed: its pipeline was built again with a background image that is in the next file only.
    """

    def __init__(self, segmenter: Segmenter) -> None:
        self._segmenter = segmenter
        self._recording: Recording | None = None
        self._begins, self._last_s = True, -math.inf
        self._pipelines: dict[str, Pipeline] = {}
        self._live = dict.fromkeys(FINGERS, False)
        self._renewed = dict.fromkeys(FINGERS, False)
        self._images: dict[str, StoredImage] = {}
        self._estimates: dict[str, dict[int, Estimate]] = {finger: {} for finger in FINGERS}

    def play(self, recording: Recording, done: ReplayResult) -> None:
        """Play one file. Pipelines go on where the last one ended if it is the next part of the same recording."""
        if self._recording is None or not _same_header(self._recording, recording):
            self._restart()
        self._recording, self._path, self._done = recording, recording.path, done
        self._begins, self._settings = True, recorded_settings(recording)
        self._states: dict[str, ControlState] = {}
        self._phase = done.phases[-1][1] if done.phases else None
        for item in recording.items():
            value = item.value
            if isinstance(value, ControlState):
                self._states = {"recorded": value, "frames": value}
            elif isinstance(value, m.FrameRecord):
                self._play_frame(_finger(item), value)
            elif isinstance(value, m.CycleRecord):
                self._play_cycle(value)
            elif (
                isinstance(value, StoredImage) and item.topic == m.IMAGE_TOPIC[value.source] and value.source in FINGERS
            ):
                self._images[value.source] = value
                done.image = value.format

    def _restart(self) -> None:
        """Forget the pipelines: the next frames are of another recording."""
        self._pipelines, self._last_s = {}, -math.inf
        self._live, self._renewed = dict.fromkeys(FINGERS, False), dict.fromkeys(FINGERS, False)
        self._estimates = {finger: {} for finger in FINGERS}

    def _play_frame(self, finger: str, record: m.FrameRecord) -> None:
        image = self._images.pop(finger, None)
        if self._begins and abs(record.captured_at_s - self._last_s) > PART_GAP_S:
            self._restart()
        self._begins, self._last_s = False, record.captured_at_s
        if record.new_pipeline:  # its background image is in the next file
            self._live[finger], self._renewed[finger] = False, True
        if record.new_reference:
            self._live[finger] = image is not None and not self._renewed[finger]
            if self._live[finger]:
                self._pipeline(finger).reset_reference()
        no_contact = record.estimate is not None and not record.estimate.contact
        if image is None and not no_contact:
            self._live[finger] = False  # the image of a frame with contact is missing
        replayed = None
        if self._live[finger] and image is not None:
            replayed = self._process(finger, image, record)
        self._done.estimates.add(record.estimate, replayed)
        estimate = replayed or record.estimate
        if estimate is not None:
            known = self._estimates[finger]
            known[record.sequence] = estimate
            while len(known) > KEPT_ESTIMATES:
                del known[next(iter(known))]

    def _process(self, finger: str, image: StoredImage, record: m.FrameRecord) -> Estimate | None:
        skipped = record.estimate is not None and record.estimate.skipped == OTHER_FINGER
        last = next(reversed(self._estimates[finger].values()), None)
        if skipped and last is not None:
            self._pipeline(finger).keep_estimate(record.captured_at_s)
            return repeat_estimate(last, record.captured_at_s, record.sequence)
        try:
            frame = Frame(image.pixels(), record.captured_at_s, record.sequence)
            return self._pipeline(finger).process(frame)
        except FrameCorrupt:
            return None

    def _pipeline(self, finger: str) -> Pipeline:
        """Return the finger's pipeline, created on first use."""
        if finger not in self._pipelines:
            self._pipelines[finger] = self._settings.new_pipeline(finger, self._segmenter)
        return self._pipelines[finger]

    def _play_cycle(self, cycle: m.CycleRecord) -> None:
        done = self._done
        if self._phase != cycle.phase and len(done.phases) < SHOWN_MAX:
            done.phases.append((cycle.now_s, cycle.phase))
        self._phase = cycle.phase
        fault = cycle.output.fault
        if fault is not None and str(fault) not in done.faults and len(done.faults) < SHOWN_MAX:
            done.faults.append(str(fault))
        if not self._states:
            raise InputError(
                f"{self._path}: a control step precedes the controller's state. The recording is incomplete"
            )
        self._states["recorded"] = self._compare(done.on_recorded, self._states["recorded"], cycle)
        fresh = {
            finger: self._estimates[finger].get(sequence) if sequence is not None else None
            for finger, sequence in zip(FINGERS, (cycle.left_sequence, cycle.right_sequence), strict=True)
        }
        if not any(self._live.values()):
            self._states["frames"] = self._states["recorded"]
            return
        observation = replace(cycle.observation, fused=fuse(fresh["left"], fresh["right"]))
        self._states["frames"] = self._compare(
            done.on_frames, self._states["frames"], replace(cycle, observation=observation)
        )

    def _compare(self, into: ControllerReplay, memory: ControlState, cycle: m.CycleRecord) -> ControlState:
        memory, output = control_step(memory, cycle.observation, self._settings.guard)
        into.ticks += 1
        if output != cycle.output:
            into.differ += 1
            if len(into.differences) < SHOWN_MAX:
                into.differences.append(CommandDifference(cycle.now_s, cycle.output, output))
        return memory


def _rotation(estimate: Estimate | None) -> float | None:
    return None if estimate is None else estimate.rotation_deg


def _plain(estimate: Estimate | None) -> Estimate | None:
    """Return the estimate without stage times, which always differ, and without what is not recorded."""
    return None if estimate is None else replace(estimate, stage_ms={}, segmented=True)


def _finger(item: RecordedItem) -> str:
    return item.topic.split("/")[1]


@dataclass(frozen=True, slots=True)
class RecordedSettings:
    """Configuration and calibration stored in a recording."""

    guard: GuardParams
    perception: PerceptionSettings
    px_per_mm: dict[str, float]
    mounting_deg: dict[str, int]
    recording: Recording

    def new_pipeline(self, finger: str, segmenter: Segmenter) -> Pipeline:
        """Return a pipeline as the finger had one when it was recorded."""
        return Pipeline(
            segmenter,
            self.perception,
            self.background(finger),
            self.noise_bgr(finger),
            self.px_per_mm[finger],
            self.mounting_deg[finger],
        )

    def background(self, finger: str) -> np.ndarray | None:
        """Return the finger's background image, (320, 240, 3) uint8; None if it is not stored. Raises InputError."""
        name = m.background_name(finger)
        encoded = self.recording.attachments.get(name)
        return None if encoded is None else decode_stored(encoded, f"{self.recording.path}: {name}")

    def noise_bgr(self, finger: str) -> tuple[float, float, float] | None:
        """Return the finger's noise in gray levels; None if it is not stored. Raises InputError if it is damaged."""
        name = f"{finger}.noise_bgr"
        text = self.recording.facts.get(name)
        try:
            return None if text is None else _NOISE.validate_json(text)
        except ValidationError as error:
            raise InputError(f"{self.recording.path}: {name}: {describe_validation_error(error)}") from None


def recorded_settings(recording: Recording) -> RecordedSettings:
    """Return the stored configuration. Raises InputError if it is missing or of another version."""
    where = f"{recording.path}: {m.CONFIG_ATTACHMENT}"
    try:
        content = recording.attachments[m.CONFIG_ATTACHMENT]
        if len(content) > m.JSON_MAX_BYTES:
            raise InputError(f"{where}: {len(content)} bytes (limit {m.JSON_MAX_BYTES})")
        config = json.loads(content)
        perception = {key: value for key, value in config["perception"].items() if key != "model"}
        return RecordedSettings(
            GuardParams.model_validate(config["guard"]),
            PerceptionSettings.model_validate(perception),
            {finger: float(config[finger]["px_per_mm"]) for finger in FINGERS},
            {finger: int(config[finger]["mounting_deg"]) for finger in FINGERS},
            recording,
        )
    except ValidationError as error:
        raise InputError(
            f"{where}: written by another version of slipguard: {describe_validation_error(error)}"
        ) from None
    except (KeyError, TypeError, ValueError, AttributeError, OverflowError, RecursionError) as error:
        raise InputError(f"{where}: missing or damaged: {error}") from None


def items_of(opened: list[Recording]) -> Iterator[RecordedItem]:
    for recording in opened:
        yield from recording.items()
