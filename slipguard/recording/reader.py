"""Read recordings, also those cut off by a kill or a full disk: everything up to the damage, and what the damage is."""

from __future__ import annotations

import contextlib
import io
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import cv2
import lz4.frame
import numpy as np
import zstandard
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.message import DecodeError
from mcap.exceptions import EndOfFile, McapError
from mcap.records import Attachment, Channel, Chunk, Message, Metadata
from mcap.stream_reader import StreamReader
from numpy.typing import NDArray

from slipguard.control.control_step import ControlState
from slipguard.errors import InputError
from slipguard.recording import messages as m

RECORD_MAX_BYTES = 8 * 2**20
"""Records of slipguard are smaller: the largest is a 4K image of an external camera, 4 MB."""
CHUNK_MAX_BYTES = 16 * 2**20
"""Content of one chunk. slipguard ends a chunk at 64 kB, after one more record."""
ATTACHMENTS_MAX, ATTACHMENTS_MAX_BYTES = 64, 16 * 2**20
"""A file has at most five: configuration, two background images, the description of a lift and of its camera."""
_DAMAGE = (
    McapError,
    DecodeError,
    InputError,
    zstandard.ZstdError,
    struct.error,
    ValueError,
    RuntimeError,
    EOFError,
    OverflowError,
)


@dataclass(frozen=True, slots=True)
class StoredImage:
    """One compressed image or mask, of a finger or the external camera. format: "jpeg" or "png"."""

    source: str
    encoded: bytes
    format: str

    def pixels(self) -> NDArray[np.uint8]:
        """Return the image, (320, 240, 3) uint8 BGR. Raises InputError if it cannot be decoded."""
        return decode_stored(self.encoded, f"an image of {self.source}")


def decode_stored(encoded: bytes, what: str) -> NDArray[np.uint8]:
    """Return the pixels of a JPEG or PNG, (H, W, 3) uint8 BGR. Raises InputError, naming `what`, if that fails."""
    image = None
    if encoded.startswith((b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n")):
        with contextlib.suppress(cv2.error):  # too many pixels, for example
            image = cv2.imdecode(np.frombuffer(encoded, np.uint8), cv2.IMREAD_COLOR)
    if image is None:
        raise InputError(f"{what} cannot be decoded")
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
        topics: dict[int, str | None] = {}
        self.damage = None
        try:
            with self.path.open("rb") as file:
                for record in _records(file):
                    if isinstance(record, Channel):
                        topics[record.id] = record.topic if record.topic in _KNOWN_TOPICS else None
                    elif isinstance(record, Message):
                        if record.channel_id not in topics:
                            raise InputError(f"a message of channel {record.channel_id}, which is not described")
                        topic = topics[record.channel_id]
                        if topic is not None:
                            yield RecordedItem(topic, record.log_time, _value(topic, record.data))
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
                    size = sum(map(len, recording.attachments.values()))
                    if len(recording.attachments) > ATTACHMENTS_MAX or size > ATTACHMENTS_MAX_BYTES:
                        raise InputError("too many or too large attachments")
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


def _records(file: BinaryIO) -> Iterator[Any]:
    """Yield the records outside and inside of the chunks, one at a time; only one chunk is in memory."""
    for record in StreamReader(file, emit_chunks=True, validate_crcs=True, record_size_limit=RECORD_MAX_BYTES).records:
        if isinstance(record, Chunk):
            content = io.BytesIO(_decompressed(record))
            inside = StreamReader(content, skip_magic=True, emit_chunks=True, record_size_limit=RECORD_MAX_BYTES)
            with contextlib.suppress(EndOfFile):  # a chunk has no record that ends it
                yield from inside.records
        else:
            yield record


def _decompressed(chunk: Chunk) -> bytes:
    """Return the content of a chunk. Raises InputError, or an error of the library, if it is not as announced.

    mcap's own reader decompresses before it compares the size; then 100 kB may become gigabytes.
    """
    size, content = chunk.uncompressed_size, bytes(chunk.data)
    if size > CHUNK_MAX_BYTES:
        raise InputError(f"a chunk of {size} bytes (limit {CHUNK_MAX_BYTES})")
    if chunk.compression == "lz4":
        content = lz4.frame.LZ4FrameDecompressor().decompress(content, max_length=size + 1)
    elif chunk.compression == "zstd":
        zstd = zstandard.ZstdDecompressor(max_window_size=CHUNK_MAX_BYTES)
        content = zstd.stream_reader(content).read(size + 1)
    elif chunk.compression:
        raise InputError(f"a chunk compressed with {chunk.compression!r}; lz4 and zstd can be read")
    if len(content) != size:
        raise InputError(f"a chunk that announces {size} bytes has {'more' if len(content) > size else len(content)}")
    if chunk.uncompressed_crc and zlib.crc32(content) != chunk.uncompressed_crc:
        raise InputError("the checksum of a chunk differs")
    return content


_TOPICS: dict[str, m.Json[Any]] = {
    m.CYCLE_TOPIC: m.CYCLE_RECORD,
    m.MEMORY_TOPIC: m.MEMORY,
    m.TRUTH_TOPIC: m.TRUTH_RECORD,
    **dict.fromkeys(m.FRAME_TOPIC.values(), m.FRAME_RECORD),
}
_SOURCE_OF = {
    topic: source for topics in (m.IMAGE_TOPIC, m.MASK_TOPIC, m.TRUE_MASK_TOPIC) for source, topic in topics.items()
}


_KNOWN_TOPICS = {*_TOPICS, *_SOURCE_OF, m.LOG_TOPIC}
"""Those of a later version are skipped."""


def _value(topic: str, data: bytes) -> Value:
    if topic in _TOPICS:
        value: ControlState | m.FrameRecord | m.CycleRecord | m.TruthRecord = _TOPICS[topic].decode(data)
        return value
    if topic in _SOURCE_OF:
        image = CompressedImage.FromString(data)
        return StoredImage(_SOURCE_OF[topic], image.data, image.format)
    message = Log.FromString(data)
    return StoredMessage(message.message, message.level >= Log.ERROR)
