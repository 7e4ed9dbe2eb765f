"""Topics and message types of a recording, and exact JSON for the controller's values.

Images and log messages are Foxglove's protobuf messages. Everything else is JSON with a JSON schema, so a viewer needs
no set-up. Numbers keep every bit, so that a replay computes the same commands.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_json

from slipguard.config_errors import describe_validation_error
from slipguard.control.control_step import ControlState
from slipguard.control.messages import Observation, StepOutput
from slipguard.devices import FINGERS
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate

FORMAT = "3"
CAMERA = "camera"
"""Source name of the external camera in the recordings of an experiment."""
IMAGE_TOPIC = {source: f"/{source}/image" for source in (*FINGERS, CAMERA)}
MASK_TOPIC = {finger: f"/{finger}/mask" for finger in FINGERS}
TRUE_MASK_TOPIC = {finger: f"/{finger}/true_mask" for finger in FINGERS}
TRUTH_TOPIC = "/truth"
FRAME_TOPIC = {finger: f"/{finger}/judged" for finger in FINGERS}
CYCLE_TOPIC = "/tick"
MEMORY_TOPIC = "/memory"
LOG_TOPIC = "/log"
HEADER = "slipguard"
"""Name of the metadata record; its values are text."""
CONFIG_ATTACHMENT = "config.json"
JSON_MAX_BYTES = 256 * 1024
"""Of one message or of the configuration: slipguard's have at most some kilobytes, and parsing takes ten times more."""


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame that a finger's pipeline received.

    new_reference: the pipeline's reference was reset just before. new_pipeline: the pipeline was built again just
    before (another unit, or a new background image). estimate: None if the frame was refused for the reason in
    `refused`.
    """

    sequence: int
    captured_at_s: float
    new_reference: bool = False
    new_pipeline: bool = False
    estimate: Estimate | None = None
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """One cycle of the loop: the controller's observation and its command.

    left_sequence, right_sequence: the frame whose estimate was used for the finger; None if none was fresh.
    """

    now_s: float
    phase: str
    observation: Observation
    output: StepOutput
    left_sequence: int | None = None
    right_sequence: int | None = None


@dataclass(frozen=True, slots=True)
class TruthRecord:
    """True state of a simulated world. rotation_deg: since the grasp, with the sign of the left finger's image."""

    now_s: float
    rotation_deg: float
    height_mm: float


T = TypeVar("T")


class Json(Generic[T]):
    """Encodes one message type as exact JSON, infinities as text.

    Args:
        kind: The message type.
        without: Fields that are left out, as `to_json` takes them; they have defaults.
    """

    def __init__(self, kind: type[T], without: dict[str, Any] | None = None) -> None:
        self._without = without
        self.name = f"slipguard.{kind.__name__}"
        self._adapter: TypeAdapter[T] = TypeAdapter(kind)

    @functools.cached_property
    def schema(self) -> bytes:
        """JSON schema of the messages."""
        return json.dumps(self._adapter.json_schema()).encode()

    def encode(self, value: T) -> bytes:
        """Return compact JSON; floats keep every bit."""
        return to_json(value, inf_nan_mode="strings", exclude=self._without)

    def decode(self, data: bytes) -> T:
        """Return the message. Raises InputError if it is damaged."""
        if len(data) > JSON_MAX_BYTES:
            raise InputError(f"a {self.name} message of {len(data)} bytes (limit {JSON_MAX_BYTES})")
        try:
            return self._adapter.validate_json(data)
        except ValidationError as error:
            raise InputError(f"not a {self.name} message: {describe_validation_error(error)}") from None


FRAME_RECORD = Json(FrameRecord, without={"estimate": {"segmented"}})
CYCLE_RECORD = Json(CycleRecord)
MEMORY = Json(ControlState)
TRUTH_RECORD = Json(TruthRecord)


def background_name(finger: str) -> str:
    return f"background-{finger}.png"
