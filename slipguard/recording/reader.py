"""Read recordings, also those cut off by a kill or a full disk: everything up to the damage, and what the damage is."""

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

from slipguard.control.control_step import ControlState
from slipguard.errors import InputError
from slipguard.recording import messages as m

RECORD_MAX_BYTES = 64 * 2**20
"""Records of slipguard are smaller; a damaged length must not allocate all memory."""
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
    """One compressed image or mask, of a finger or the external camera. format: "jpeg" or "png"."""

    source: str
    encoded: bytes
    format: str

    def pixels(self) -> NDArray[np.uint8]:
        """Return the image, (320, 240, 3) uint8 BGR. Raises InputError if it cannot be decoded."""
        image = cv2.imdecode(np.frombuffer(self.encoded, np.uint8), cv2.IMREAD_COLOR)
        if image is None:
            raise InputError(f"an image of {self.source} cannot be decoded")
        return np.asarray(image, np.uint8)


@dataclass(frozen=True, slots=True)
class StoredMessage:
    """One message of the log."""

    text: str
    error: bool


Value = ControlState | m.FrameRecord | m.CycleRecord | m.TruthRecord | StoredImage | StoredMessage


@dataclass(frozen=True, slots=True)
class RecordedItem:
    """One message: its topic, its wall-clock time in nanoseconds since 1970, and its value."""

    topic: str
    at_ns: int
    value: Value


@dataclass(slots=True)
class Recording:
    """One file. facts and attachments come from its beginning; `damage` is known once `items` is exhausted."""

    path: Path
    facts: dict[str, str] = field(default_factory=dict)
    attachments: dict[str, bytes] = field(default_factory=dict)
    damage: str | None = None
    """Why reading ended before the end of the file; None if it did not."""

    def items(self) -> Iterator[RecordedItem]:
        """Yield all messages in the order written; ends early at a damage, which is then in `damage`."""
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
    """Read the header of a recording. Raises InputError if it is no recording of slipguard."""
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
            raise InputError(f"{path}: not an MCAP recording, or cut off at its beginning") from None
    if "format" not in recording.facts:
        raise InputError(f"{path}: not a recording of slipguard, or cut off before its header")
    if recording.facts["format"] != m.FORMAT:
        raise InputError(
            f"{path}: written in format {recording.facts['format']}; this slipguard reads format {m.FORMAT}"
        )
    return recording


def _records(file: Any) -> Iterator[Any]:
    return StreamReader(file, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES).records


_TOPICS: dict[str, m.Json[Any]] = {
    m.CYCLE_TOPIC: m.CYCLE_RECORD,
    m.MEMORY_TOPIC: m.MEMORY,
    m.TRUTH_TOPIC: m.TRUTH_RECORD,
    **dict.fromkeys(m.FRAME_TOPIC.values(), m.FRAME_RECORD),
}
_SOURCE_OF = {
    topic: source for topics in (m.IMAGE_TOPIC, m.MASK_TOPIC, m.TRUE_MASK_TOPIC) for source, topic in topics.items()
}


def _value(topic: str, data: bytes) -> Value | None:
    """Return the message; None for a topic of a later version."""
    if topic in _TOPICS:
        value: ControlState | m.FrameRecord | m.CycleRecord | m.TruthRecord = _TOPICS[topic].decode(data)
        return value
    if topic in _SOURCE_OF:
        image = CompressedImage.FromString(data)
        return StoredImage(_SOURCE_OF[topic], image.data, image.format)
    if topic == m.LOG_TOPIC:
        message = Log.FromString(data)
        return StoredMessage(message.message, message.level >= Log.ERROR)
    return None
