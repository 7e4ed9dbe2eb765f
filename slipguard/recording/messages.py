"""What a recording is made of: topics, their message types, and exact JSON for the law's values.

Pictures and log lines are Foxglove's own protobuf messages, everything else is JSON described by a JSON schema, so a
viewer needs no set-up. Numbers survive to the last bit: a replay must find the very same commands.
"""

from __future__ import annotations

import functools
import json
from dataclasses import dataclass
from typing import Generic, TypeVar

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_json

from slipguard.config_errors import first_complaint
from slipguard.control.messages import Command, Observation
from slipguard.control.step import ControlState
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate

FORMAT = "1"
FINGERS = ("left", "right")
CAMERA = "camera"
"""An external camera, in the recordings of an experiment."""
IMAGE_TOPIC = {source: f"/{source}/image" for source in (*FINGERS, CAMERA)}
MASK_TOPIC = {finger: f"/{finger}/mask" for finger in FINGERS}
TRUE_MASK_TOPIC = {finger: f"/{finger}/true_mask" for finger in FINGERS}
TRUTH_TOPIC = "/truth"
JUDGED_TOPIC = {finger: f"/{finger}/judged" for finger in FINGERS}
TICK_TOPIC = "/tick"
MEMORY_TOPIC = "/memory"
LOG_TOPIC = "/log"
HEADER = "slipguard"
"""Name of the metadata record; its values are text."""
CONFIG_ATTACHMENT = "config.json"


@dataclass(frozen=True, slots=True)
class FrameRecord:
    """One frame that a finger's pipeline was given.

    new_reference: the pipeline forgot its reference just before. new_pipeline: it was built anew (another unit, or a
    new no-contact image). estimate: None where the frame was refused; then `refused` says why.
    """

    sequence: int
    captured_at_s: float
    new_reference: bool = False
    new_pipeline: bool = False
    estimate: Estimate | None = None
    refused: str | None = None


@dataclass(frozen=True, slots=True)
class CycleRecord:
    """One turn of the loop: what the law was told and what it commanded.

    left_sequence, right_sequence: the frame whose estimate spoke for the finger; None where none was fresh.
    """

    now_s: float
    phase: str
    observation: Observation
    command: Command
    left_sequence: int | None = None
    right_sequence: int | None = None


@dataclass(frozen=True, slots=True)
class TruthRecord:
    """What a simulated world knows. rotation_deg: since the grasp, in the left picture's sign."""

    now_s: float
    rotation_deg: float
    height_mm: float


T = TypeVar("T")


class Json(Generic[T]):
    """One message type as JSON: exact, infinities as text, refused in one line when damaged."""

    def __init__(self, kind: type[T]) -> None:
        self.name = f"slipguard.{kind.__name__}"
        self._kind = kind
        self._adapter: TypeAdapter[T] = TypeAdapter(kind)

    @functools.cached_property
    def schema(self) -> bytes:
        """JSON schema of the messages; made once, for every recording has it."""
        return json.dumps(self._adapter.json_schema()).encode()

    def encode(self, value: T) -> bytes:
        """Compact JSON; floats come back to the last bit."""
        return to_json(value, inf_nan_mode="strings")

    def decode(self, data: bytes) -> T:
        """Raises InputError for what is no such message."""
        try:
            return self._adapter.validate_json(data)
        except ValidationError as error:
            raise InputError(f"no {self.name}: {first_complaint(error)}") from None


FRAME_RECORD = Json(FrameRecord)
CYCLE_RECORD = Json(CycleRecord)
MEMORY = Json(ControlState)
TRUTH_RECORD = Json(TruthRecord)


def background_name(finger: str) -> str:
    """Attachment that holds the finger's no-contact image."""
    return f"no_contact-{finger}.png"
