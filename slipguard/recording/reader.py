"""Reading recordings back, also those cut off by a kill or a full disk: all up to the damage, then a word on it."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import DecodeError
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from slipguard.control.step import ControlState
from slipguard.errors import InputError
from slipguard.recording import messages as m

RECORD_MAX_BYTES = 64 * 2**20
"""No record of ours is larger; a damaged length must not ask for all the memory there is."""
_DAMAGE = (
    McapError,
    DecodeError,
    InputError,
    struct.error,
    ValueError,
    RuntimeError,
    EOFError,
    OverflowError,
    KeyError,
)


@dataclass(frozen=True, slots=True)
class StoredImage:
    """One compressed picture, of a finger or the external camera: an image or a mask. format: "jpeg" or "png"."""

    source: str
    encoded: bytes
    format: str

    def pixels(self) -> NDArray[np.uint8]:
        """(320, 240, 3) uint8 BGR; raises InputError if it is no picture."""
        image = cv2.imdecode(np.frombuffer(self.encoded, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError(f"a picture of {self.source} cannot be decoded")
        return np.asarray(image, np.uint8)


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """One line that was said."""

    text: str
    error: bool


Value = ControlState | m.FrameRecord | m.CycleRecord | m.TruthRecord | StoredImage | StoredMessage


@dataclass(frozen=True, slots=True)
class RecordedItem:
    """One message: its topic, when (wall clock, nanoseconds since 1970), and what it says."""

    topic: str
    at_ns: int
    value: Value


@dataclass(slots=True)
class Recording:
    """One file. facts and attachments are those it began with; `damage` is known once `items` has been exhausted."""

    path: Path
    facts: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    damage: str | None = None
    """Why reading ended before the file's own end; None if it did not."""

    def items(self) -> Iterator[RecordedItem]:
        """All messages in the order written; ends early, and says so in `damage`, where the file is damaged."""
        topics: dict[int, str] = {}
        self.damage = None
        try:
            with self.path.open("rb") as file:
                for record in _records(file):
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic
                    elif isinstance(record, Message):
                        value = _value(topics[record.channel_id], record.data)
                        if value is not None:
                            yield RecordedItem(topics[record.channel_id], record.log_time, value)
        except _DAMAGE as error:
            if isinstance(error, EndOfFile):
                self.damage = "is cut off (killed, or the disk was full)"
            else:
                self.damage = f"is damaged: {error or type(error).__name__}"
        except OSError as error:
            self.damage = f"cannot be read: {error.strerror}"


def open_recording(path: Path) -> Recording:
    """Read what a recording says of itself. Raises InputError for what is no recording of slipguard."""
    recording = Recording(path)
    try:
        with path.open("rb") as file:
            for record in _records(file):
                if isinstance(record, Metadata) and record.name == m.HEADER:
                    recording.facts = dict(record.metadata)
                elif isinstance(record, Attachment):
                    recording.attachments[record.name] = record.data
                elif isinstance(record, Message):
                    break
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    except _DAMAGE:
        if not recording.facts:
            raise InputError(f"{path}: not an MCAP recording, or cut off at its very start") from None
    if "format" not in recording.facts:
        raise InputError(f"{path}: no recording of slipguard, or cut off before its header")
    if recording.facts["format"] != m.FORMAT:
        raise InputError(
            f"{path}: written in format {recording.facts['format']}; this slipguard reads format {m.FORMAT}"
        )
    return recording


def _records(file: Any) -> Iterator[Any]:
    return StreamReader(file, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES).records


_TOPICS: dict[str, m.Json[Any]] = {
    m.TICK_TOPIC: m.CYCLE_RECORD,
    m.MEMORY_TOPIC: m.MEMORY,
    m.TRUTH_TOPIC: m.TRUTH_RECORD,
    **dict.fromkeys(m.JUDGED_TOPIC.values(), m.FRAME_RECORD),
}
_SOURCE_OF = {
    topic: source for topics in (m.IMAGE_TOPIC, m.MASK_TOPIC, m.TRUE_MASK_TOPIC) for source, topic in topics.items()
}


def _value(topic: str, data: bytes) -> Value | None:
    """The message; None for a topic that a later version may have added."""
    if topic in _TOPICS:
        value: ControlState | m.FrameRecord | m.CycleRecord | m.TruthRecord = _TOPICS[topic].decode(data)
        return value
    if topic in _SOURCE_OF:
        picture = CompressedImage.FromString(data)
        return StoredImage(_SOURCE_OF[topic], picture.data, picture.format)
    if topic == m.LOG_TOPIC:
        line = Log.FromString(data)
        return StoredMessage(line.message, line.level >= Log.ERROR)
    return None
