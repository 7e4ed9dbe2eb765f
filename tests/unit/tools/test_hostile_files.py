"""`measure` and `replay` take files from anywhere: little memory, one line, never a wrong measurement."""

from __future__ import annotations

import json
import struct
import subprocess
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import cv2
import lz4.frame
import numpy as np
import pytest
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Chunk, Header, Message, Metadata

from slipguard import IMAGE_PIXELS_MAX
from slipguard.recording import messages as m
from slipguard.recording.reader import ATTACHMENTS_MAX, CHUNK_MAX_BYTES
from slipguard.recording.ring import MAGIC

MEMORY_MAX_KB = 300_000
COLOR = (10, 120, 200)
SIDE_PX = 3600


def bomb_png() -> bytes:
    """18,000 x 24,000 pixels in 1.3 MB."""
    return small_png(18_000, 24_000)


def small_png(width: int, height: int) -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    packer, row = zlib.compressobj(9), b"\0" + bytes(COLOR) * width
    content = b"".join(packer.compress(row) for _ in range(height)) + packer.flush()
    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", content) + chunk(b"IEND", b"")


def bomb_bmp() -> bytes:
    """Run-length encoded: a whole image in a few bytes."""
    header = struct.pack("<IiiHHIIiiII", 40, SIDE_PX, SIDE_PX, 1, 8, 1, 0, 0, 0, 256, 0)
    return b"BM" + struct.pack("<IHHI", 0, 0, 0, 54 + 1024) + header + bytes(1024) + b"\xff\1" * 500 + b"\0\1"


def encoded(ending: str, *settings: int) -> Callable[[], bytes]:
    return lambda: cv2.imencode(ending, np.full((SIDE_PX, SIDE_PX, 3), COLOR, np.uint8), settings)[1].tobytes()


def bomb_tiff(tags: dict[int, tuple[int, list[int]]]) -> bytes:
    """An image of 240 x 320 with these further tags: (type, values)."""
    usual = {256: (4, [240]), 257: (4, [320]), 258: (3, [8, 8, 8]), 259: (3, [8]), 262: (3, [2]), 277: (3, [3])}
    every = sorted((usual | tags).items())
    entries, rest, rest_at = b"", b"", 10 + 12 * len(every) + 4
    for tag, (kind, values) in every:
        content = struct.pack(f"<{len(values)}{'H' if kind == 3 else 'I'}", *values)
        if len(content) > 4:
            content, rest = struct.pack("<I", rest_at + len(rest)), rest + content
        entries += struct.pack("<HHI", tag, kind, len(values)) + content.ljust(4, b"\0")
    return b"II*\0" + struct.pack("<IH", 8, len(every)) + entries + bytes(4) + rest


IMAGES: dict[str, tuple[Callable[[], bytes], str]] = {
    "png": (bomb_png, "more than 12500000 pixels"),
    "bmp": (bomb_bmp, "more than 12500000 pixels"),
    "jpg": (encoded(".jpg"), "more than 12500000 pixels"),
    "jpg, progressive": (encoded(".jpg", cv2.IMWRITE_JPEG_PROGRESSIVE, 1), "more than 12500000 pixels"),
    "webp": (encoded(".webp"), "more than 12500000 pixels"),
    "tif": (encoded(".tif"), "more than 12500000 pixels"),
    "tif, tiles": (lambda: bomb_tiff({322: (4, [16_000]), 323: (4, [16_000])}), "a TIFF in tiles"),
    "tif, 64 bits": (lambda: bomb_tiff({258: (3, [64, 64, 64])}), "64 bits per channel"),
}
PACK = {"lz4": lz4.frame.compress, "zstd": zstandard.ZstdCompressor(level=3).compress}


def recording(*after: bytes) -> bytes:
    builder = RecordBuilder()
    Header(profile="", library="slipguard").write(builder)
    Metadata(m.HEADER, {"format": m.FORMAT}).write(builder)
    config = json.dumps({"guard": {}, "perception": {}, "left": FINGER, "right": FINGER}).encode()
    Attachment(0, 0, m.CONFIG_ATTACHMENT, "application/json", config).write(builder)
    return MAGIC + builder.end() + b"".join(after)


FINGER = {"px_per_mm": 18.5, "mounting_deg": 0}


def chunk(compression: str, content: bytes, announced: int | None = None, packed: bytes | None = None) -> bytes:
    builder = RecordBuilder()
    size = len(content) if announced is None else announced
    packed = PACK.get(compression, bytes)(content) if packed is None else packed
    Chunk(compression, packed, 0, 0, 0, size).write(builder)
    return builder.end()


def records(*items: Channel | Message) -> bytes:
    builder = RecordBuilder()
    for item in items:
        item.write(builder)
    return builder.end()


def unknown_topics() -> bytes:
    """Channels with long names, which compress well: 1 GB in all."""
    channels = (Channel(number, str(number) + "x" * 60_000, "", {}, 0) for number in range(16_000))
    return b"".join(chunk("zstd", records(*(next(channels) for _ in range(250)))) for _ in range(64))


def tiny_messages() -> bytes:
    """Half a million messages of a topic that is not read, in 16 MB of one chunk."""
    message = records(Message(1, 0, b"", 0, 0))
    count = (CHUNK_MAX_BYTES - 100) // len(message)
    return chunk("zstd", records(Channel(1, "/else", "", {}, 0)) + message * count)


def of_topic(topic: str, data: bytes) -> bytes:
    return chunk("", records(Channel(1, topic, "json", {}, 0), Message(1, 0, data, 0, 0)))


def attachments() -> bytes:
    builder = RecordBuilder()
    for number in range(ATTACHMENTS_MAX + 1):
        Attachment(0, 0, f"{number}.json", "application/json", bytes(800_000)).write(builder)
    return builder.end()


GIGABYTE = 1 << 30
RECORDINGS: dict[str, tuple[Callable[[], bytes], str]] = {
    "zstd of 4 GB": (
        lambda: chunk("zstd", b"", 4 * GIGABYTE, zstandard.ZstdCompressor().compress(bytes(GIGABYTE // 8))),
        "is damaged: a chunk of 4294967296 bytes (limit 16777216)",
    ),
    "zstd that hides its size": (
        lambda: chunk("zstd", bytes(GIGABYTE // 4), 1000),
        "is damaged: a chunk that announces 1000 bytes has more",
    ),
    "lz4 that hides its size": (
        lambda: chunk("lz4", bytes(GIGABYTE // 4), 1000),
        "is damaged: a chunk that announces 1000 bytes has more",
    ),
    "a chunk shorter than announced": (
        lambda: chunk("zstd", bytes(900), 1000),
        "is damaged: a chunk that announces 1000 bytes has 900",
    ),
    "zstd that is none": (lambda: chunk("zstd", b"", 1000, b"nothing"), "is damaged: zstd decompress"),
    "lz4 that is none": (lambda: chunk("lz4", b"", 1000, b"nothing"), "is damaged: LZ4F_"),
    "another compression": (lambda: chunk("brotli", bytes(9)), "is damaged: a chunk compressed with 'brotli'"),
    "names of channels": (unknown_topics, "is cut off"),
    "tiny messages": (tiny_messages, "is cut off"),
    "JSON of 4 MB": (lambda: of_topic(m.CYCLE_TOPIC, b"[" * 2**22), "message of 4194304 bytes (limit 262144)"),
    "deep JSON": (lambda: of_topic(m.CYCLE_TOPIC, b"[" * 2**17), "not valid JSON: recursion limit"),
    "attachments": (attachments, "is cut off"),
    "a message of no channel": (
        lambda: chunk("", records(Message(7, 0, b"", 0, 0))),
        "a message of channel 7, which is not described",
    ),
    "a record of 1 GB": (lambda: struct.pack("<BQ", Opcode.SCHEMA, GIGABYTE), "is damaged: "),
}


MEASURED = """
import re, sys
from slipguard.cli.app import run
code = run(sys.argv[1:])
print(re.search("VmHWM:\\s+(\\d+) kB", open("/proc/self/status").read())[1])
sys.exit(code)
"""


def run(*words: object) -> tuple[int, str, int]:
    """Return exit code, stderr and the largest memory in kB of `slipguard WORDS...`."""
    done = subprocess.run([sys.executable, "-c", MEASURED, *map(str, words)], capture_output=True, text=True)
    return done.returncode, done.stderr, int(done.stdout.splitlines()[-1])


@pytest.mark.parametrize("kind", IMAGES)
def test_an_image_that_would_fill_the_memory_is_refused(kind: str, tmp_path: Path) -> None:
    make, reason = IMAGES[kind]
    path = tmp_path / f"bomb.{kind.partition(',')[0]}"
    path.write_bytes(make())
    code, errors, memory_kb = run("measure", path, "--json")
    assert reason in errors.splitlines()[-1]
    assert "Traceback" not in errors
    assert code == 2
    assert memory_kb < MEMORY_MAX_KB


LARGEST = {
    "png": (".png", np.uint8, 4, "partly transparent"),
    "png, 16 bits": (".png", np.uint16, 4, "16 bits per channel"),
    "tif, 16 bits": (".tif", np.uint16, 4, "16 bits per channel"),
    "jpg": (".jpg", np.uint8, 3, "4100x3000"),
    "webp": (".webp", np.uint8, 3, "4100x3000"),
}


@pytest.mark.parametrize("kind", LARGEST)
def test_the_largest_images_take_little_memory(kind: str, tmp_path: Path) -> None:
    ending, dtype, channels, reason = LARGEST[kind]
    image = np.zeros((3000, 4100, channels), dtype)
    image[..., 0] = 5
    assert 0.95 * IMAGE_PIXELS_MAX < image.shape[0] * image.shape[1] < IMAGE_PIXELS_MAX
    (tmp_path / f"large{ending}").write_bytes(cv2.imencode(ending, image)[1].tobytes())
    code, errors, memory_kb = run("measure", tmp_path / f"large{ending}", "--json")
    assert reason in errors.splitlines()[-1]
    assert code == 2
    assert memory_kb < MEMORY_MAX_KB


def test_a_video_that_would_fill_the_memory_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "bomb.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (6144, 8192))
    video.write(np.full((8192, 6144, 3), COLOR, np.uint8))
    video.release()
    code, errors, memory_kb = run("measure", path, "--json")
    assert "6144x8192 pixels, more than 8388608" in errors.splitlines()[-1]
    assert code == 2
    assert memory_kb < MEMORY_MAX_KB


def test_many_frames_take_no_more_memory_than_one(tmp_path: Path) -> None:
    path = tmp_path / "long.avi"
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (240, 320))
    frame = np.random.default_rng(0).integers(90, 110, (320, 240, 3), np.uint8)
    for _ in range(1500):
        video.write(frame)
    video.release()
    code, _, memory_kb = run("measure", path, "--plot", tmp_path / "plot.png")
    assert code == 0
    assert memory_kb < MEMORY_MAX_KB, "its images alone would take 345 MB"


@pytest.mark.parametrize("kind", RECORDINGS)
def test_a_recording_that_would_fill_the_memory_is_damaged(kind: str, tmp_path: Path) -> None:
    make, reason = RECORDINGS[kind]
    path = tmp_path / "bomb.mcap"
    path.write_bytes(recording(make()))
    assert path.stat().st_size < 100e6
    code, errors, memory_kb = run("replay", path, "--against")
    assert errors.count("\n") == 1
    assert reason in errors
    assert errors.endswith("; no control step could be read\n")
    assert code == 1
    assert memory_kb < MEMORY_MAX_KB
