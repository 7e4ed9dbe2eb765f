"""One recording file; what was written stays readable if the program is killed."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, Literal

from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.Log_pb2 import Log
from google.protobuf.timestamp_pb2 import Timestamp
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import build_file_descriptor_set

from slipguard.control.control_step import ControlState
from slipguard.recording import messages as m

CHUNK_BYTES = 64 * 1024
"""A file is readable up to its last complete chunk. The loop alone fills one in half a second, images in less."""

Level = Literal["info", "error"]
_LEVELS = {"info": Log.INFO, "error": Log.ERROR}


@dataclass(frozen=True, slots=True)
class RecordingClock:
    """Converts the event loop's monotonic seconds to the wall-clock nanoseconds of a recording."""

    wall_ns: int
    monotonic_s: float

    def ns(self, at_s: float) -> int:
        """Return the wall-clock time in nanoseconds since 1970."""
        return max(self.wall_ns + round(1e9 * (at_s - self.monotonic_s)), 0)

    def s(self, wall_ns: int) -> float:
        """Return the event loop's time in seconds."""
        return self.monotonic_s + 1e-9 * (wall_ns - self.wall_ns)


@dataclass(frozen=True, slots=True)
class RecordingHeader:
    """Header of a file. facts: texts, such as versions. attachments: name -> content, .json or .png."""

    facts: Mapping[str, str]
    attachments: Mapping[str, bytes]


def open_new(path: Path) -> BinaryIO:
    """Open a new file, unbuffered, for its user and group only. Raises FileExistsError instead of overwriting one."""
    return open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640), "wb", buffering=0)


class RecordingFile:
    """An open recording. Every method may raise OSError, for example on a full disk; then only `abandon` may follow.

    If the beginning cannot be written, no file remains. opener: opens a new file, unbuffered.
    """

    def __init__(
        self,
        path: Path,
        clock: RecordingClock,
        header: RecordingHeader,
        memory: ControlState,
        now_s: float,
        opener: Callable[[Path], BinaryIO] = open_new,
    ) -> None:
        self.path = path
        self._clock = clock
        self._stream = _Stream(opener(path))
        self._writer = Writer(self._stream, chunk_size=CHUNK_BYTES, compression=CompressionType.LZ4)  # type: ignore[arg-type]
        self._schemas: dict[str, int] = {}
        self._channels: dict[str, int] = {}
        try:
            self._begin(header, memory, now_s)
        except BaseException:
            with contextlib.suppress(OSError):
                self._stream.close()
            path.unlink(missing_ok=True)
            raise

    def _begin(self, header: RecordingHeader, memory: ControlState, now_s: float) -> None:
        self._writer.start(profile="", library="slipguard")
        self._writer.add_metadata(m.HEADER, {"format": m.FORMAT, **header.facts})
        now_ns = self._clock.ns(now_s)
        for name, content in header.attachments.items():
            kind = "image/png" if name.endswith(".png") else "application/json"
            self._writer.add_attachment(now_ns, now_ns, name, kind, content)
        self._json(m.MEMORY_TOPIC, m.MEMORY, memory, now_s)

    @property
    def size_bytes(self) -> int:
        return self._stream.tell()

    def image(self, source: str, at_s: float, encoded: bytes, kind: Literal["jpeg", "png"]) -> None:
        """Write an image of a finger or of the external camera, captured at `at_s`."""
        self._image(m.IMAGE_TOPIC[source], source, at_s, encoded, kind)

    def mask(self, finger: str, at_s: float, png: bytes) -> None:
        """Write the contact mask of the image captured at `at_s`: 240 x 320, 0 or 255."""
        self._image(m.MASK_TOPIC[finger], finger, at_s, png, "png")

    def true_mask(self, finger: str, at_s: float, png: bytes) -> None:
        """Write the true contact mask of the image captured at `at_s`."""
        self._image(m.TRUE_MASK_TOPIC[finger], finger, at_s, png, "png")

    def truth(self, truth: m.TruthRecord) -> None:
        self._json(m.TRUTH_TOPIC, m.TRUTH_RECORD, truth, truth.now_s)

    def frame(self, finger: str, at_s: float, record: m.FrameRecord) -> None:
        self._json(m.FRAME_TOPIC[finger], m.FRAME_RECORD, record, at_s)

    def cycle(self, record: m.CycleRecord) -> None:
        self._json(m.CYCLE_TOPIC, m.CYCLE_RECORD, record, record.now_s)

    def log(self, at_s: float, level: Level, text: str) -> None:
        at_ns = self._clock.ns(at_s)
        message = Log(timestamp=_stamp(at_ns), level=_LEVELS[level], message=text, name="slipguard")
        self._add(m.LOG_TOPIC, Log, at_ns, message.SerializeToString())

    def close(self) -> None:
        """Write the index, without which a reader must scan the whole file, and close. Raises OSError."""
        try:
            self._writer.finish()  # type: ignore[no-untyped-call]
        finally:
            self._stream.close()

    def abandon(self) -> None:
        """Close without writing anything more."""
        self._stream.close()

    def _image(self, topic: str, source: str, at_s: float, encoded: bytes, kind: str) -> None:
        at_ns = self._clock.ns(at_s)
        image = CompressedImage(timestamp=_stamp(at_ns), frame_id=source, data=encoded, format=kind)
        self._add(topic, CompressedImage, at_ns, image.SerializeToString())

    def _json(self, topic: str, kind: m.Json[Any], value: Any, at_s: float) -> None:
        if topic not in self._channels:
            if kind.name not in self._schemas:
                self._schemas[kind.name] = self._writer.register_schema(kind.name, "jsonschema", kind.schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", self._schemas[kind.name])
        at_ns = self._clock.ns(at_s)
        self._writer.add_message(self._channels[topic], at_ns, kind.encode(value), at_ns)

    def _add(self, topic: str, kind: Any, at_ns: int, data: bytes) -> None:
        if topic not in self._channels:
            name = kind.DESCRIPTOR.full_name
            if name not in self._schemas:
                self._schemas[name] = self._writer.register_schema(name, "protobuf", _descriptors(kind))
            self._channels[topic] = self._writer.register_channel(topic, "protobuf", self._schemas[name])
        self._writer.add_message(self._channels[topic], at_ns, data, at_ns)


@functools.cache
def _descriptors(kind: Any) -> bytes:
    descriptors: bytes = build_file_descriptor_set(kind).SerializeToString()
    return descriptors


class _Stream:
    """An unbuffered file that writes everything or raises, and counts its bytes."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._at = 0
        self.flush = functools.partial(file.flush)

    def write(self, data: bytes) -> int:
        remaining = memoryview(data)
        while remaining:
            done = self._file.write(remaining)
            remaining = remaining[done:]
            self._at += done
        return len(data)

    def tell(self) -> int:
        return self._at

    def close(self) -> None:
        self._file.close()


def _stamp(at_ns: int) -> Timestamp:
    return Timestamp(seconds=at_ns // 1_000_000_000, nanos=at_ns % 1_000_000_000)
