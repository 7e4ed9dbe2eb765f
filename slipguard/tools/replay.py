"""A recording played again: the same frames through the pipeline, the same sights through the law, and what differs.

The law is played twice: on what was recorded of the fingers (it must give the very same commands), and, where there are
pictures, on what the pipeline says now. A finger's pipeline joins in at the first new reference of the recording: what
it knew before is not in the file. Nothing moves in a replay: after the first difference the recorded world no longer
answers to the commands, so the first one counts.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path

import cv2
import numpy as np
from pydantic import ValidationError

from slipguard.config_errors import first_complaint
from slipguard.control.finger_fusion import fuse
from slipguard.control.messages import Command
from slipguard.control.params import GuardParams
from slipguard.control.step import ControlState, control_step
from slipguard.devices import Frame
from slipguard.errors import FrameCorrupt, InputError
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.skipping import OTHER_FINGER, repeat_estimate
from slipguard.recording import messages as m
from slipguard.recording.reader import RecordedItem, Recording, StoredImage, open_recording
from slipguard.recording.ring import SUFFIX

KEPT_ESTIMATES = 64
"""So many estimates of a finger are remembered; the loop uses none older than 150 ms."""


@dataclass(frozen=True, slots=True)
class CommandDifference:
    """A command that a replay gave otherwise."""

    now_s: float
    recorded: Command
    replayed: Command


@dataclass(frozen=True, slots=True)
class ReplayedEstimate:
    """One judged frame: what was recorded, and what the pipeline says now (None: it was not asked)."""

    finger: str
    recorded: m.FrameRecord
    replayed: Estimate | None


@dataclass(slots=True)
class ControllerReplay:
    """ticks played, and every command that came out otherwise."""

    ticks: int = 0
    differences: list[CommandDifference] = field(default_factory=list)


@dataclass(slots=True)
class ReplayResult:
    """What came of a replay. on_recorded: the law on the recorded sights; on_frames: on the pipeline's answers now."""

    on_recorded: ControllerReplay = field(default_factory=ControllerReplay)
    on_frames: ControllerReplay = field(default_factory=ControllerReplay)
    answers: list[ReplayedEstimate] = field(default_factory=list)
    phases: list[tuple[float, str]] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    damage: list[str] = field(default_factory=list)
    other_model: bool = False
    image: str = "none"

    @property
    def asked(self) -> list[ReplayedEstimate]:
        """Frames that went through the pipeline again."""
        return [answer for answer in self.answers if answer.replayed is not None]

    @property
    def estimates_differ(self) -> int:
        """How many of them it now judges otherwise, be it in the last bit."""
        return sum(_plain(one.recorded.estimate) != _plain(one.replayed) for one in self.asked)

    @property
    def turn_differences_deg(self) -> list[float]:
        """Where both tell a turn: now minus then."""
        both = ((_rotation(one.recorded.estimate), _rotation(one.replayed)) for one in self.asked)
        return [now - then for then, now in both if then is not None and now is not None]


def recordings(paths: Iterable[Path]) -> list[Recording]:
    """Open files, or all recordings of a folder, in the order of their names. Raises InputError."""
    files: list[Path] = []
    for path in paths:
        found = sorted(path.glob(f"*{SUFFIX}")) if path.is_dir() else [path]
        if not found:
            raise InputError(f"{path}: no {SUFFIX} files in this folder")
        files += found
    return [open_recording(file) for file in files]


def replay(opened: list[Recording], model: Path | None = None) -> ReplayResult:
    """Play recordings one after the other; each begins with the law's own memory of that moment.

    Raises ModelError for a model that is none, whether or not a frame comes that it is to see.
    """
    segmenter = Segmenter(model)
    done = ReplayResult(other_model=model is not None)
    for recording in opened:
        done.image = "none"
        _RecordingPlayer(recording, segmenter, done).play()
        if recording.damage is not None:
            done.damage.append(f"{recording.path.name} {recording.damage}")
    return done


class _RecordingPlayer:
    """Plays one file into a `Replay`."""

    def __init__(self, recording: Recording, segmenter: Segmenter, done: ReplayResult) -> None:
        self._recording, self._done = recording, done
        settings = recorded_settings(recording)
        self._params: GuardParams = settings.guard
        self._segmenter, self._settings = segmenter, settings
        self._pipelines: dict[str, Pipeline] = {}
        self._live = dict.fromkeys(m.FINGERS, False)
        self._renewed = dict.fromkeys(m.FINGERS, False)
        self._pictures: dict[str, StoredImage] = {}
        self._now: dict[str, dict[int, Estimate]] = {finger: {} for finger in m.FINGERS}
        self._memory: dict[str, ControlState] = {}

    def play(self) -> None:
        for item in self._recording.items():
            value = item.value
            if isinstance(value, ControlState):
                self._memory = {"recorded": value, "frames": value}
            elif isinstance(value, m.FrameRecord):
                self._judged(_finger(item), value)
            elif isinstance(value, m.CycleRecord):
                self._tick(value)
            elif (
                isinstance(value, StoredImage)
                and item.topic == m.IMAGE_TOPIC[value.source]
                and value.source in m.FINGERS
            ):
                self._pictures[value.source] = value
                self._done.image = value.format

    def _judged(self, finger: str, judged: m.FrameRecord) -> None:
        picture = self._pictures.pop(finger, None)
        if judged.new_pipeline:  # its no-contact image is in the next file
            self._live[finger], self._renewed[finger] = False, True
        if judged.new_reference:
            self._live[finger] = picture is not None and not self._renewed[finger]
            if self._live[finger]:
                self._pipeline(finger).reset_reference()
        boring = judged.estimate is not None and not judged.estimate.contact
        if picture is None and not boring:
            self._live[finger] = False  # a frame that mattered was left out
        now = None
        if self._live[finger] and picture is not None:
            now = self._process(finger, picture, judged)
        self._done.answers.append(ReplayedEstimate(finger, judged, now))
        estimate = now or judged.estimate
        if estimate is not None:
            known = self._now[finger]
            known[judged.sequence] = estimate
            while len(known) > KEPT_ESTIMATES:
                del known[next(iter(known))]

    def _process(self, finger: str, picture: StoredImage, judged: m.FrameRecord) -> Estimate | None:
        spared = judged.estimate is not None and judged.estimate.skipped == OTHER_FINGER
        last = next(reversed(self._now[finger].values()), None)
        if spared and last is not None:
            self._pipeline(finger).keep_estimate(judged.captured_at_s)
            return repeat_estimate(last, judged.captured_at_s, judged.sequence)
        try:
            frame = Frame(picture.pixels(), judged.captured_at_s, judged.sequence)
            return self._pipeline(finger).process(frame)
        except FrameCorrupt:
            return None

    def _pipeline(self, finger: str) -> Pipeline:
        """The finger's own, made when it is first needed."""
        if finger not in self._pipelines:
            settings = self._settings
            self._pipelines[finger] = Pipeline(
                self._segmenter,
                settings.perception,
                settings.background(finger),
                settings.noise_bgr(finger),
                settings.px_per_mm[finger],
                settings.mounting_deg[finger],
            )
        return self._pipelines[finger]

    def _tick(self, told: m.CycleRecord) -> None:
        done = self._done
        if not done.phases or done.phases[-1][1] != told.phase:
            done.phases.append((told.now_s, told.phase))
        fault = told.command.fault
        if fault is not None and str(fault) not in done.faults:
            done.faults.append(str(fault))
        if not self._memory:
            raise InputError(f"{self._recording.path}: a turn of the loop comes before the law's memory")
        self._memory["recorded"] = self._compare(done.on_recorded, self._memory["recorded"], told)
        fresh = {
            finger: self._now[finger].get(sequence) if sequence is not None else None
            for finger, sequence in zip(m.FINGERS, (told.left_sequence, told.right_sequence), strict=True)
        }
        if not any(self._live.values()):
            self._memory["frames"] = self._memory["recorded"]
            return
        observation = replace(told.observation, fused=fuse(fresh["left"], fresh["right"]))
        self._memory["frames"] = self._compare(
            done.on_frames, self._memory["frames"], replace(told, observation=observation)
        )

    def _compare(self, into: ControllerReplay, memory: ControlState, told: m.CycleRecord) -> ControlState:
        memory, command = control_step(memory, told.observation, self._params)
        into.ticks += 1
        if command != told.command:
            into.differences.append(CommandDifference(told.now_s, told.command, command))
        return memory


def _rotation(estimate: Estimate | None) -> float | None:
    return None if estimate is None else estimate.angle_deg


def _plain(estimate: Estimate | None) -> Estimate | None:
    """Without the stage times, which are never the same."""
    return None if estimate is None else replace(estimate, stage_ms={})


def _finger(item: RecordedItem) -> str:
    return item.topic.split("/")[1]


@dataclass(frozen=True, slots=True)
class RecordedSettings:
    """What a recording says of the configuration it was made with."""

    guard: GuardParams
    perception: PerceptionSettings
    px_per_mm: dict[str, float]
    mounting_deg: dict[str, int]
    recording: Recording

    def background(self, finger: str) -> np.ndarray | None:
        """The finger's no-contact image, (320, 240, 3) uint8."""
        encoded = self.recording.attachments.get(m.background_name(finger))
        if encoded is None:
            return None
        image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
        return None if image is None else np.asarray(image, np.uint8)

    def noise_bgr(self, finger: str) -> list[float] | None:
        """Its noise, grey levels."""
        text = self.recording.facts.get(f"{finger}.noise_bgr")
        return None if text is None else [float(level) for level in json.loads(text)]


def recorded_settings(recording: Recording) -> RecordedSettings:
    """Raises InputError where the recording has no configuration of this version."""
    where = f"{recording.path}: {m.CONFIG_ATTACHMENT}"
    try:
        config = json.loads(recording.attachments[m.CONFIG_ATTACHMENT])
        perception = {key: value for key, value in config["perception"].items() if key != "model"}
        return RecordedSettings(
            GuardParams.model_validate(config["guard"]),
            PerceptionSettings.model_validate(perception),
            {finger: float(config[finger]["px_per_mm"]) for finger in m.FINGERS},
            {finger: int(config[finger]["mounting_deg"]) for finger in m.FINGERS},
            recording,
        )
    except ValidationError as error:
        raise InputError(f"{where}: from another version of slipguard: {first_complaint(error)}") from None
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(f"{where}: missing or damaged ({error})") from None


def items_of(opened: list[Recording]) -> Iterator[RecordedItem]:
    """All messages of several recordings, in order."""
    for recording in opened:
        yield from recording.items()
