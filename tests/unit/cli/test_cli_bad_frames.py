"""Bad frames and networks in `slipguard measure`: one line and exit code 2, never a confident wrong angle."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slipguard
from sampled import sampled

from slipguard.perception.segmenter import default_model_path

KEYS = {
    "frame", "contact", "contact_area_px", "angle_deg", "orientation_deg",
    "sigma_deg", "method", "reference", "skipped", "declined", "stage_ms",
}  # fmt: skip


def gel(seed: int = 0) -> np.ndarray:
    """An untouched gel: the glow of three lamps with camera noise, (320, 240, 3) uint8."""
    y, x = np.mgrid[0:320, 0:240].astype(np.float32)
    glow = np.stack([90 - 40 * y / 320, 60 + 60 * x / 240, 140 - 80 * x / 240], -1)
    return np.clip(glow + np.random.default_rng(seed).normal(0.0, 1.5, glow.shape), 0, 255).astype(np.uint8)


def png(image: np.ndarray) -> bytes:
    return cv2.imencode(".png", image)[1].tobytes()


BAD = {
    "empty": (b"", "the file is empty"),
    "truncated": (png(gel())[:4000], "truncated"),
    "1x1": (png(np.full((1, 1, 3), (9, 90, 200), np.uint8)), "1x1"),
    "16-bit": (png(gel().astype(np.uint16) * 256), "16 bits per channel"),
    "gray": (png(gel()[..., 1]), "gray"),
    "half transparent": (png(np.dstack([gel(), np.full((320, 240), 90, np.uint8)])), "transparent"),
    "4K": (png(cv2.resize(gel(), (3840, 2160))), "3840x2160"),
    "all black": (png(np.zeros((320, 240, 3), np.uint8)), "all black"),
    "all white": (png(np.full((320, 240, 3), 255, np.uint8)), "all white"),
    "NaN": (cv2.imencode(".tiff", np.full((320, 240, 3), np.nan, np.float32))[1].tobytes(), "32 bits per channel"),
    "text": (b"not an image", "not a decodable image"),
}


@pytest.fixture
def background(tmp_path: Path) -> Path:
    path = tmp_path / "background.png"
    path.write_bytes(png(gel(9)))
    return path


@pytest.mark.parametrize("kind", sampled(BAD))
def test_a_bad_frame_is_named(kind: str, background: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data, output = BAD[kind]
    bad = tmp_path / ("bad.tiff" if kind == "NaN" else "bad.png")
    bad.write_bytes(data)
    ran = slipguard(capfd, "measure", bad, "--background", background, "--json")
    assert ran.complaint.startswith(f"{bad}: ")
    assert output in ran.complaint
    assert ran.code == 2
    assert json.loads(ran.out) == {"error": ran.complaint}
    ran = slipguard(capfd, "measure", background, "--background", bad, "--json")
    assert ran.complaint.startswith(f"{bad}: ")
    assert ran.code == 2


def test_opaque_rgba_and_4k_portrait_are_read_as_the_same_image(
    background: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "rgba.png").write_bytes(png(np.dstack([gel(1), np.full((320, 240), 255, np.uint8)])))
    (tmp_path / "large.png").write_bytes(png(cv2.resize(gel(1), (2160, 2880), interpolation=cv2.INTER_NEAREST)))
    paths = [tmp_path / "rgba.png", tmp_path / "large.png"]
    ran = slipguard(capfd, "measure", *paths, "--background", background, "--json", "--masks", tmp_path / "masks")
    assert ran.code == 0
    assert [json.loads(line)["contact"] for line in ran.out.splitlines()] == [False, False]
    assert cv2.imread(str(tmp_path / "masks" / "large.png"), cv2.IMREAD_UNCHANGED).shape == (2880, 2160)


def test_every_line_has_exactly_the_documented_keys(background: Path, capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd, "measure", background, "--background", background, "--json")
    assert ran.code == 0
    assert ran.err == ""
    (line,) = ran.out.splitlines()
    seen = json.loads(line)
    assert set(seen) == KEYS
    assert (seen["contact"], seen["angle_deg"], seen["sigma_deg"], seen["skipped"]) == (False, None, None, "no contact")


def test_a_folder_without_images(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "notes.txt").write_text("no image")
    ran = slipguard(capfd, "measure", tmp_path)
    assert "no image in this folder" in ran.complaint
    assert ran.code == 2


def _other_inputs() -> bytes:
    whole = default_model_path().read_bytes()
    assert b"background_known" in whole
    return whole.replace(b"background_known", b"background_knowm")


def _constant_output() -> bytes:
    """The shipped network with zeros for the weights of its last layer."""
    whole = default_model_path().read_bytes()
    before, name, after = whole.partition(b"net.head.weightJ")
    size = (after[0] & 0x7F) | after[1] << 7  # protobuf: a length of two bytes, then the weights
    return before + name + after[:2] + bytes(size) + after[2 + size :]


MODELS = {
    "missing": (None, "no such file"),
    "empty": (b"", "not a readable ONNX model"),
    "corrupt": (default_model_path().read_bytes()[:9000], "not a readable ONNX model"),
    "text": (b"weights go here", "not a readable ONNX model"),
    "other inputs": (_other_inputs(), "the model contract asks for"),
    "metadata that are no text": (
        default_model_path().read_bytes().replace(b"displaced", b"\xff" * 9),
        "its metadata are not text",
    ),
    "constant output": (_constant_output(), "the output is the same for different frames"),
}


@pytest.mark.parametrize("kind", MODELS)
def test_a_bad_network_is_named(kind: str, background: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data, output = MODELS[kind]
    model = tmp_path / "net.onnx"
    if data is not None:
        model.write_bytes(data)
    ran = slipguard(capfd, "measure", background, "--background", background, "--model", model)
    assert ran.complaint.startswith(f"{model}: ")
    assert output in ran.complaint
    assert ran.code == 2


@pytest.mark.parametrize("option", ["--masks", "--plot"])
def test_a_folder_that_cannot_be_written_to(
    option: str, background: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("")
    ran = slipguard(capfd, "measure", background, "--background", background, "--json", option, tmp_path / "file/x.png")
    assert str(tmp_path / "file") in ran.complaint
    assert ran.code == 2
