"""The cases of `fuzz`: `python -m tests.campaigns.fuzz_cases KIND SEED FIRST COUNT FOLDER KEEP` prints a line for each.

A case is made by its number and the seed alone. Its input is valid but for one to four changes: of bytes, or of values
inside of what is then a well-formed file, because a checksum would hide these. A failure is an exception that is no
`SlipguardError`, or a complaint of several lines.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
import os
import re
import shutil
import sys
import tempfile
import tomllib
import traceback
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from random import Random
from typing import Any

import cv2
import numpy as np

from slipguard.cli.app import run
from slipguard.config import sim_config
from slipguard.control.control_step import ControlState, control_step
from slipguard.control.finger_fusion import fuse
from slipguard.control.messages import Observation
from slipguard.control.params import GuardParams
from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.dated_file import save_time
from slipguard.daemon.store.last_grasp import restore_control_state
from slipguard.daemon.store.last_reference import ReferenceStore
from slipguard.daemon.store.recording import config_json
from slipguard.daemon.store.state_dir import LastGrasp, StateDir
from slipguard.devices import FINGERS, ArmState, Frame, GripperState
from slipguard.errors import SlipguardError
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter, default_model_path
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stored_reference import StoredReference
from slipguard.recording import messages as m
from slipguard.recording.writer import RecordingClock, RecordingFile, RecordingHeader
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit
from slipguard_drivers.digit.decoding import DamagedFrame, check_jpeg, decode_jpeg, decode_yuyv

Image = np.ndarray[Any, np.dtype[Any]]
MEMORY = re.compile(r"VmHWM:\s+(\d+) kB")
ROOT = Path(__file__).parents[2]
SERIAL = "D20001"
HOSTILE: tuple[Any, ...] = (
    *(None, True, -1, 0, 2**31, 2**63, 10**400, 1e300, -1e-300, 1e18, math.nan, math.inf, -math.inf, "", "\0", "nan"),
    *("x" * 5000, "\n", "../..", "\x1b[2J", "é" * 300, [], [[[]]], {}, {"a": {"b": {"c": {}}}}, [0] * 5000, "1e999"),
    *("2026-01-01T00:00:00", "0001-01-01T00:00:00+14:00", "9999-12-31T23:59:59-14:00", "Infinity", [1, "2", None]),
)


def changed_bytes(draw: Random, data: bytes) -> bytes:
    """Return the data with one to four changes: bits, bytes, ranges removed, repeated or overwritten, a cut."""
    changed = bytearray(data)
    for _ in range(draw.randint(1, 4)):
        at = draw.randrange(len(changed) + 1)
        size = min(draw.choice((1, 2, 4, 8, 100, 5000)), len(changed) - at)
        match draw.randrange(7):
            case 0 if changed:
                changed[at % len(changed)] ^= 1 << draw.randrange(8)
            case 1:
                changed[at : at + size] = draw.randbytes(size)
            case 2:
                del changed[at : at + size]
            case 3:
                changed[at:at] = changed[at : at + size] * draw.randint(1, 3)
            case 4:
                changed[at : at + size] = draw.choice((b"\0", b"\xff", b"\x7f")) * size
            case 5:
                changed[at : at + 4] = draw.choice((0, 1, 2**16, 2**24, 2**31 - 1, 2**32 - 1)).to_bytes(4, "little")
            case _:
                del changed[at:]
    return bytes(changed)


def changed_value(draw: Random, value: Any) -> Any:
    """Return JSON-like data with one value changed, left out, renamed or added, at a random depth."""
    if isinstance(value, dict) and value and draw.random() < 0.85:
        key = draw.choice(list(value))
        match draw.randrange(12):
            case 0:
                return {name: one for name, one in value.items() if name != key}
            case 1:
                return value | {draw.choice(("", "extra", "a" * 300, "\0", "é")): draw.choice(HOSTILE)}
            case 2:
                return {name if name != key else name + "x": one for name, one in value.items()}
        return value | {key: changed_value(draw, value[key])}
    if isinstance(value, list) and value and draw.random() < 0.7:
        at = draw.randrange(len(value))
        return [*value[:at], changed_value(draw, value[at]), *value[at + 1 :]]
    if isinstance(value, int | float) and not isinstance(value, bool) and abs(value) < 1e300 and draw.random() < 0.3:
        return value * draw.choice((-1, 0.0, 1e6, 1e-6, 2))
    return draw.choice(HOSTILE)


def as_json(value: Any) -> bytes:
    return json.dumps(value).encode()


def as_toml(table: dict[str, Any]) -> str:
    """Return a table as TOML, sub-tables inline, which allows any nesting."""
    return "\n".join(f"{json.dumps(key)} = {_toml_value(value)}" for key, value in table.items())


def _toml_value(value: Any) -> str:
    if isinstance(value, dict):
        return "{" + ", ".join(f"{json.dumps(key)} = {_toml_value(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list):
        return "[" + ", ".join(map(_toml_value, value)) + "]"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value}".replace("Infinity", "inf")
    return '""' if value is None else json.dumps(value)


# --- one function for each kind: makes the input in a folder, and gives it to the product; returns an exit code ---


def configuration(draw: Random, folder: Path) -> int:
    path = folder / "config.toml"
    text = (ROOT / "config.toml").read_bytes()
    if draw.random() < 0.5:
        path.write_bytes(changed_bytes(draw, text))
    else:
        table = tomllib.loads(text.decode())
        for _ in range(draw.randint(1, 3)):
            changed = changed_value(draw, table)
            table = changed if isinstance(changed, dict) else table
        with contextlib.suppress(ValueError):  # an integer that Python does not print
            path.write_text(as_toml(table), encoding="utf-8", errors="surrogatepass")
    return run(["check", "--config", str(path)])


def state(draw: Random, folder: Path) -> int:
    store, references = StateDir(folder), ReferenceStore(folder / "references")
    image = gel_image(0)
    fault = Fault(FaultCode.GRIPPER_SILENT, "no answer for 2.0 s", "check its cable")
    store.save_last_grasp(LastGrasp(**save_time(), force_n=40.0, width_mm=18.0, lift_start_mm=(0, 0, 1), fault=fault))
    store.save_background(SERIAL, BackgroundImage(image, (2.0, 2.0, 2.0), 30))
    references.save("left", SERIAL, StoredReference(image, 3.0, 0.0))
    path = draw.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
    change_file(draw, path)
    lines: list[str] = []
    restored = restore_control_state(store, draw.choice((None, datetime.now(UTC))), lines.append)
    if path.name == "last_grasp.json" and restored == ControlState():
        raise AssertionError("a changed file says that nothing was held")
    assert all("\n" not in line for line in lines), lines
    for read in (
        lambda: store.load_background(SERIAL),
        lambda: store.background_versions(SERIAL),
        lambda: store.background_created_at(SERIAL),
        lambda: store.first_of_gel(SERIAL),
        lambda: references.load("left", SERIAL),
    ):
        with contextlib.suppress(SlipguardError):
            read()
    store.save_background(SERIAL, BackgroundImage(image, (2.0, 2.0, 2.0), 30))
    return 2 if lines else 0


def change_file(draw: Random, path: Path) -> None:
    """Change a file, or replace it by what is none."""
    content = path.read_bytes()
    choice = draw.randrange(20)
    if choice < 5:
        path.unlink()
        match choice:
            case 0:
                path.symlink_to(path.with_name("missing"))
            case 1:
                path.symlink_to(path)
            case 2:
                path.mkdir()
            case 3:
                os.mkfifo(path)
            case _:
                path.symlink_to("/dev/zero")
    elif path.suffix == ".json" and choice < 14:
        changed = as_json(changed_value(draw, json.loads(content)))
        path.write_bytes(changed if changed != content else b"{}")
    else:
        changed = changed_bytes(draw, content)
        path.write_bytes(changed if changed != content else b"")


def recording(draw: Random, folder: Path) -> int:
    path = folder / "a.mcap"
    if draw.random() < 0.5:
        path.write_bytes(changed_bytes(draw, intact_recording()))
    else:
        write_recording(path, draw)
    if draw.random() < 0.2:
        return run(["replay", str(path), "--export", str(folder / "out"), "--as", draw.choice(("csv", "png", "mp4"))])
    return run(["replay", str(path), *(["--against"] if draw.random() < 0.5 else [])])


def image(draw: Random, folder: Path) -> int:
    """An image, or a video."""
    if draw.random() < 0.15:
        ending, code = draw.choice(((".avi", "MJPG"), (".mkv", "FFV1"), (".mp4", "avc1"), (".avi", "I420")))
        path = folder / f"a{ending}"
        path.write_bytes(changed_bytes(draw, video(ending, code)))
        return run(["measure", str(path), "--json"])
    ending = draw.choice((".png", ".jpg", ".bmp", ".tif", ".webp"))
    shown = draw.choice((gel_image(1), gel_image(1), cv2.resize(gel_image(1), (480, 640)), gel_image(1)[:100]))
    settings = draw.choice(([], [cv2.IMWRITE_JPEG_PROGRESSIVE, 1], [cv2.IMWRITE_JPEG_RST_INTERVAL, 4]))
    data = cv2.imencode(ending, shown, settings if ending == ".jpg" else [])[1].tobytes()
    changed = changed_bytes(draw, data[:200]) + data[200:] if draw.random() < 0.5 else changed_bytes(draw, data)
    if ending == ".png" and draw.random() < 0.7:
        changed = with_checksums(changed)
    path = folder / f"a{draw.choice((ending, ending, '.png'))}"
    path.write_bytes(changed)
    return run(["measure", str(path), "--json", *(["--independent"] if draw.random() < 0.1 else [])])


def with_checksums(png: bytes) -> bytes:
    """Return a PNG with the right checksum of each chunk, so that a decoder gets the changes."""
    fixed, at = bytearray(png), 8
    while at + 12 <= len(fixed):
        end = at + 8 + int.from_bytes(fixed[at : at + 4], "big")
        if end + 4 > len(fixed):
            break
        fixed[end : end + 4] = zlib.crc32(fixed[at + 4 : end]).to_bytes(4, "big")
        at = end + 4
    return bytes(fixed)


def model(draw: Random, folder: Path) -> int:
    """The graph lies before the weights, the metadata behind them: most changes go there."""
    content = default_model_path().read_bytes()
    start = content.index(b"net.stem.weight.half", 100)
    parts = [content[:start], content[start:-2000], content[-2000:]]
    part = draw.choice((0, 0, 1, 2))
    parts[part] = changed_bytes(draw, parts[part])
    path = folder / "net.onnx"
    path.write_bytes(b"".join(parts))
    config = folder / "config.toml"
    shipped = (ROOT / "config.toml").read_text()
    config.write_text(f'{shipped}\n[perception]\nmodel = "{path}"\n')
    return run(["check", "--config", str(config)])


def frames(draw: Random, folder: Path) -> int:
    """What a camera may deliver: bytes of a frame, and images of any values, sizes, types and times."""
    data = changed_bytes(draw, wire_jpeg())
    try:
        check_jpeg(data)
        decode_jpeg(data)
        decode_yuyv(data)
    except DamagedFrame:
        pass
    pipeline = make_pipeline(draw.random() < 0.7)
    refused, now_s = 0, 0.0
    for number in range(6):
        now_s += draw.choice((1 / 60, 1 / 60, 1 / 60, 0.0, -5.0, 1e9, math.nan, math.inf))
        try:
            found = pipeline.process(Frame(hostile_image(draw, number), now_s, number))
        except SlipguardError:
            refused += 1
            continue
        if found.contact and draw.random() < 0.1:
            pipeline.reset_reference()
        for value in (found.rotation_deg, found.sigma_deg, found.orientation_deg, found.rate_deg_s):
            assert value is None or math.isfinite(value), found
    return refused


def hostile_image(draw: Random, number: int) -> Any:
    shown = gel_image(draw.randrange(4)).copy()
    match draw.randrange(14):
        case 0:
            shown[:] = draw.randrange(256)
        case 1:
            shown[draw.randrange(320) :] = draw.randrange(256)
        case 2:
            shown = np.asarray(shown * draw.choice((0.02, 0.3, 8.0)) % 256, np.uint8)
        case 3:
            shown = np.random.default_rng(draw.randrange(99)).integers(0, 256, (320, 240, 3), np.uint8)
        case 4:
            shown = shown[: draw.choice((0, 1, 100))]
        case 5:
            wrong: Image = shown.astype(draw.choice((np.float32, np.float64, np.uint16)))
            return np.multiply(wrong, draw.choice((1, math.nan, -1e30)))
        case 6:
            shown[..., draw.randrange(3)] = 0
        case 7:
            shown = np.roll(shown, draw.randrange(-50, 50), draw.randrange(2))
        case 8:
            shown = shown[..., 0]
    return shown


KINDS: dict[str, Callable[[Random, Path], int]] = {
    "configuration": configuration,
    "state": state,
    "recording": recording,
    "image": image,
    "model": model,
    "frames": frames,
}

# --- valid inputs ---


@cache
def gel_image(number: int) -> Image:
    """A pressed bar, rotated by 5° for each number, (320, 240, 3) uint8."""
    camera = GelCamera(SensorUnit(), seed=number)
    return camera.draw(GelView("bar", angle_deg=20.0 + 5.0 * number, depth_mm=0.8))


@cache
def video(ending: str, code: str) -> bytes:
    """Eight frames; another codec where this OpenCV cannot write the wanted one."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"a{ending}"
        for one in (code, "mp4v", "MJPG"):
            writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*one), 30.0, (240, 320))
            if writer.isOpened():
                break
        for number in range(8):
            writer.write(gel_image(number % 4))
        writer.release()
        return path.read_bytes()


@cache
def background_image() -> Image:
    return GelCamera(SensorUnit(), seed=9).draw(GelView("", depth_mm=-1.0))


@cache
def segmenter() -> Segmenter:
    return Segmenter()


def make_pipeline(with_background: bool = True) -> Pipeline:
    background = background_image() if with_background else None
    noise = (2.0, 2.0, 2.0) if with_background else None
    return Pipeline(segmenter(), PerceptionSettings(), background, noise, 18.5)


@cache
def wire_jpeg() -> bytes:
    return cv2.imencode(".jpg", cv2.rotate(gel_image(0), cv2.ROTATE_90_CLOCKWISE))[1].tobytes()


@cache
def recorded() -> tuple[tuple[str, Any], ...]:
    """The messages of a recording of a held object: (topic, value)."""
    pipelines = {finger: make_pipeline() for finger in FINGERS}
    found: list[tuple[str, Any]] = []
    memory = ControlState()
    memory = replace(memory, grasp=replace(memory.grasp, phase=Phase.HOLDING))
    found.append((m.MEMORY_TOPIC, memory))
    for number in range(6):
        now_s = 10.0 + number / 30
        estimates = {}
        for finger, pipeline in pipelines.items():
            shown = gel_image(number % 4)
            estimates[finger] = pipeline.process(Frame(shown, now_s, number))
            found.append((m.IMAGE_TOPIC[finger], cv2.imencode(".png", shown)[1].tobytes()))
            found.append((m.FRAME_TOPIC[finger], m.FrameRecord(number, now_s, number == 0, False, estimates[finger])))
        gripper = GripperState(True, False, True, False, 18.0, 40.0, None, now_s)
        arm = ArmState(1.0, 0.0, False, False, False, now_s, True, (0.0, 0.0, 1.0), (0.0, 0.0, 0.0))
        seen = Observation(now_s, gripper=gripper, arm=arm, fused=fuse(estimates["left"], estimates["right"]))
        before, (memory, output) = memory, control_step(memory, seen, GuardParams())
        phase = before.grasp.phase.value
        found.append((m.CYCLE_TOPIC, m.CycleRecord(now_s, phase, seen, output, number, number)))
    return tuple(found)


def write_recording(path: Path, draw: Random | None = None) -> None:
    """Write a recording; with `draw`, with changed values in a well-formed file."""
    config = config_json(sim_config())
    background = cv2.imencode(".png", background_image())[1].tobytes()
    changes = draw.sample(range(-2, len(recorded())), draw.randint(1, 3)) if draw is not None else []
    if draw is not None and -1 in changes:
        config = as_json(changed_value(draw, json.loads(config)))
    if draw is not None and -2 in changes:
        background = changed_bytes(draw, background)
    facts = {f"{finger}.noise_bgr": "[2.0, 2.0, 2.0]" for finger in FINGERS} | {"slipguard": "0"}
    if draw is not None and draw.random() < 0.1:
        facts = facts | {"left.noise_bgr": json.dumps(draw.choice(HOSTILE))}
    attachments = {m.CONFIG_ATTACHMENT: config, **{m.background_name(finger): background for finger in FINGERS}}
    clock = RecordingClock(1_700_000_000_000_000_000, 0.0)
    file = RecordingFile(path, clock, RecordingHeader(facts, attachments), recorded()[0][1], 10.0)
    for number, (topic, value) in enumerate(recorded()):
        data = value if isinstance(value, bytes) else JSON_OF[topic].encode(value)
        if draw is not None and number in changes:
            if draw.random() < 0.15:
                continue
            data = (
                changed_bytes(draw, data)
                if isinstance(value, bytes)
                else as_json(changed_value(draw, json.loads(data)))
            )
        if isinstance(value, bytes):
            file.image(topic.split("/")[1], 10.0, data, "png")
        else:
            file._json(topic, _Encoded(JSON_OF[topic], data), None, 10.0 if draw is None else draw.choice((10.0, 1e9)))
    file.close()


class _Encoded(m.Json[Any]):
    """A message type whose message is encoded already."""

    def __init__(self, kind: m.Json[Any], data: bytes) -> None:
        self.name, self.schema, self._data = kind.name, b"{}", data

    def encode(self, value: Any) -> bytes:
        return self._data


JSON_OF: dict[str, m.Json[Any]] = {
    m.MEMORY_TOPIC: m.MEMORY,
    m.CYCLE_TOPIC: m.CYCLE_RECORD,
    **dict.fromkeys(m.FRAME_TOPIC.values(), m.FRAME_RECORD),
}


@cache
def intact_recording() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        write_recording(Path(folder) / "a.mcap")
        return (Path(folder) / "a.mcap").read_bytes()


# --- the process ---


def run_case(kind: str, seed: int, number: int, folder: Path, keep: Path | None) -> dict[str, Any]:
    """Run one case in a new folder. Returns its outcome, its failure if there is one, and the memory used so far."""
    case = folder / "case"
    shutil.rmtree(case, ignore_errors=True)
    case.mkdir()
    outcome, failure, printed = "", None, io.StringIO()
    try:
        with contextlib.redirect_stderr(printed), contextlib.redirect_stdout(io.StringIO()):
            outcome = str(KINDS[kind](Random(f"{kind}-{seed}-{number}"), case))
        complaint = [line for line in printed.getvalue().splitlines() if line.startswith("slipguard: ")][-1:]
        if outcome not in ("0", "1", "2") and kind != "frames":
            failure = f"exit code {outcome}"
        elif complaint and printed.getvalue().splitlines()[-1:] != complaint:
            failure = f"lines after the complaint: {printed.getvalue()!r}"
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        where = traceback.extract_tb(error.__traceback__)[-1]
        outcome, failure = (
            type(error).__name__,
            f"{type(error).__name__}: {error} ({where.filename}:{where.lineno})"[:500],
        )
    if failure is not None and keep is not None:
        shutil.copytree(case, keep / f"{kind}-{seed}-{number}", dirs_exist_ok=True, symlinks=True)
    memory_kb = MEMORY.search(Path("/proc/self/status").read_text())
    assert memory_kb is not None
    return {"number": number, "outcome": outcome, "failure": failure, "memory_mb": int(memory_kb[1]) / 1024}


def _main(kind: str, seed: int, first: int, count: int, folder: str, keep: str) -> None:
    with _own_output() as report:
        for number in range(first, first + count):
            print(json.dumps(run_case(kind, seed, number, Path(folder), Path(keep) if keep else None)), file=report)
            report.flush()


@contextlib.contextmanager
def _own_output() -> Iterator[io.TextIOWrapper]:
    """Provide standard output, while what C libraries print there and on standard error is discarded."""
    with os.fdopen(os.dup(1), "w", encoding="utf-8") as report:
        nothing = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nothing, 1)
        os.dup2(nothing, 2)
        yield report


if __name__ == "__main__":
    _main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), sys.argv[5], sys.argv[6])
