"""`slipguard evaluate` with videos, sheets and boards, valid and invalid."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from sampled import sampled

from slipguard.cli.app import run
from slipguard.errors import InputError
from slipguard.evaluation.camera_calibration import calibrate_camera, read_intrinsics
from slipguard.evaluation.markers import MarkerDetector, cells, charuco
from slipguard.evaluation.protocol import SIMULATED, LiftProtocol, read_protocol
from slipguard.evaluation.simulated_lifts import intrinsics_of
from slipguard.sim.external_camera import (
    ExternalCameraModel,
    ExternalCameraRenderer,
    LensModel,
    MarkerPlate,
    MarkerScene,
)

LENS = LensModel(640, 480, 560.0, (322.0, 238.0))
LOOK = ExternalCameraModel(
    gripper=MarkerPlate(cells(0), 40.0, (0.0, 95.0, 3.0)),
    object=MarkerPlate(cells(1), 40.0, (70.0, 0.0, 6.0)),
    lens=LENS,
    distance_mm=450.0,
    aim_mm=(30.0, 70.0, 0.0),
)


def video(path: Path, covered: frozenset[str] = frozenset(), count: int = 24) -> Path:
    renderer = ExternalCameraRenderer(LOOK, 1)
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (LENS.width_px, LENS.height_px))
    for number in range(count):
        rotation_deg = float(np.clip((number - 11) * 2.0, 0.0, 20.0))
        writer.write(renderer.draw(MarkerScene(rotation_deg, covered=covered)))
    writer.release()
    return path


@pytest.fixture
def camera(tmp_path: Path) -> Path:
    path = tmp_path / "camera.json"
    path.write_text(intrinsics_of(LENS).model_dump_json())
    return path


def rotation(source: Path, camera: Path, *more: str) -> int:
    return run(["evaluate", "rotation", str(source), "--intrinsics", str(camera), *more])


def test_a_video_gives_the_rotation(tmp_path: Path, camera: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert rotation(video(tmp_path / "a.avi"), camera, "--json", "--plot", str(tmp_path / "rotation.png")) == 0
    lines = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert len(lines) == 24
    assert lines[-1]["turn_deg"] == pytest.approx(20.0, abs=0.3)
    assert cv2.imread(str(tmp_path / "rotation.png")) is not None


def test_a_folder_of_images_gives_the_rotation(
    tmp_path: Path, camera: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    renderer = ExternalCameraRenderer(LOOK, 1)
    for number in range(12):
        cv2.imwrite(str(tmp_path / f"{number:03d}.png"), renderer.draw(MarkerScene(0.5 * number)))
    assert rotation(tmp_path, camera) == 0
    assert "12 of 12 images show both markers" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("covered", "word"),
    [({"gripper", "object"}, "no marker was found"), ({"object"}, "marker of the object (id 1) was not found")],
)
def test_a_video_without_markers_is_one_line(
    tmp_path: Path, camera: Path, capsys: pytest.CaptureFixture[str], covered: set[str], word: str
) -> None:
    assert rotation(video(tmp_path / "a.avi", frozenset(covered), 8), camera) == 2
    message = capsys.readouterr().err
    assert word in message
    assert message.count("\n") == 1


@pytest.mark.campaign
def test_a_truncated_or_invalid_video_is_one_line(tmp_path: Path, camera: Path) -> None:
    whole = video(tmp_path / "whole.avi").read_bytes()
    broken = {
        "half.avi": whole[: len(whole) // 2],
        "stub.avi": whole[:200],
        "text.mkv": b"\x1aE\xdf\xa3 nothing",
        "missing.mp4": None,
    }
    for name, content in broken.items():
        if content is not None:
            (tmp_path / name).write_bytes(content)
        # A process of its own: the decoders write to its standard error themselves.
        command = [sys.executable, "-m", "slipguard", "evaluate", "rotation", str(tmp_path / name)]
        done = subprocess.run([*command, "--intrinsics", str(camera)], capture_output=True, text=True, check=False)
        assert done.returncode == 2, name
        assert done.stderr.count("\n") == 1, done.stderr
        assert name in done.stderr


@pytest.mark.parametrize(
    ("content", "word"),
    [
        ("{", "no camera intrinsics"),
        ('{"format": 1, "width_px": 640}', "missing"),
        (intrinsics_of(replace(LENS, width_px=800)).model_dump_json(), "640x480, the intrinsics are for 800x480"),
    ],
)
def test_wrong_intrinsics_are_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: str, word: str
) -> None:
    path = tmp_path / "camera.json"
    path.write_text(content)
    assert rotation(video(tmp_path / "a.avi", count=6), path) == 2
    message = capsys.readouterr().err
    assert word in message
    assert message.count("\n") == 1


@pytest.mark.parametrize("name", sampled(["sheet.png", "sheet.pdf", "board.png"]))
def test_sheets_are_at_true_scale(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    assert run(["evaluate", "markers", "--out", str(path), *(["--charuco"] if name.startswith("board") else [])]) == 0
    if path.suffix == ".pdf":
        assert path.read_bytes().startswith(b"%PDF")
        return
    page = cv2.imread(str(path))
    assert page.shape[1] == pytest.approx(297 / 25.4 * 300, abs=2)
    if name == "sheet.png":
        page[: page.shape[0] // 2] = 255  # of each marker there are two
        corners = MarkerDetector().detect(page, 0.0)
        assert corners.object_px is not None
        side_px = np.linalg.norm(corners.object_px[0] - corners.object_px[1])
        assert side_px == pytest.approx(40.0 / 25.4 * 300, rel=0.005)


def board_images(tilts_deg: list[tuple[float, float]]) -> list[np.ndarray]:
    """The board seen through the lens, tilted about both axes."""
    flat = charuco().generateImage((1400, 1000))
    matrix, images = LENS.matrix(), []
    grid = np.stack(np.meshgrid(np.arange(640), np.arange(480)), -1).reshape(-1, 1, 2).astype(np.float64)
    ideal = cv2.undistortPoints(grid, matrix, LENS.distortion(), P=matrix).reshape(480, 640, 2).astype(np.float32)
    for number, (a, b) in enumerate(tilts_deg):
        rotated = cv2.Rodrigues(np.radians([a, b, 3.0 * number]))[0]
        corners = np.array([[-122.5, -87.5, 0], [122.5, -87.5, 0], [122.5, 87.5, 0], [-122.5, 87.5, 0]])
        seen = corners @ rotated.T + np.array([8.0 * (number % 3 - 1), 5.0 * (number % 2), 380.0])
        pixels = (seen[:, :2] / seen[:, 2:] * LENS.focal_px + np.array(LENS.center_px)).astype(np.float32)
        source = np.array([[0, 0], [1400, 0], [1400, 1000], [0, 1000]], np.float32) - 0.5
        warp = cv2.getPerspectiveTransform(source, pixels)
        drawn = cv2.warpPerspective(flat, warp, (640, 480), flags=cv2.INTER_AREA, borderValue=(255,))
        seen_through = cv2.remap(drawn, ideal[..., 0], ideal[..., 1], cv2.INTER_LINEAR, borderValue=(255,))
        images.append(cv2.cvtColor(seen_through, cv2.COLOR_GRAY2BGR))
    return images


TILTS = [(25.0, 0.0), (-25.0, 5.0), (0.0, 28.0), (5.0, -28.0), (18.0, 18.0), (-18.0, -15.0), (12.0, -22.0), (0.0, 0.0)]


def test_images_of_the_board_give_the_intrinsics(tmp_path: Path) -> None:
    boards, out = tmp_path / "boards", tmp_path / "camera.json"
    boards.mkdir()
    for number, image in enumerate(board_images(TILTS)):
        cv2.imwrite(str(boards / f"{number}.png"), image)
    assert run(["evaluate", "calibrate-camera", str(boards), "--out", str(out)]) == 0
    found = read_intrinsics(out)
    assert found.focal_px == pytest.approx(LENS.focal_px, rel=0.01)
    assert found.cx_px == pytest.approx(LENS.center_px[0], abs=4.0)


def test_boards_of_equal_tilt_or_too_few_boards_are_rejected() -> None:
    with pytest.raises(InputError, match="of the same tilt"):
        calibrate_camera(board_images([(1.0, 0.0)] * 8))
    with pytest.raises(InputError, match="found in 3 of 3 images; at least 6"):
        calibrate_camera(board_images(TILTS[:3]))


def test_the_protocol_spreads_its_rotations_and_rejects_invalid_values(tmp_path: Path) -> None:
    lifts = SIMULATED.lifts()
    assert len(lifts) == 45
    assert sum(item.seen for item in SIMULATED.objects) == 2
    for item in SIMULATED.objects:
        bands = sorted(int((lift.target_deg - 5.0) / 7.0) for lift in lifts if lift.item.name == item.name)
        assert bands == [0, 1, 2, 3, 4]
    path = tmp_path / "p.toml"
    path.write_text('repeats = 2\nobjects = [{name = "mug"}, {name = "mug"}]\n')
    with pytest.raises(InputError, match="named twice"):
        read_protocol(path)
    path.write_text('objects = [{name = "mug", colour = "red"}]\n')
    with pytest.raises(InputError, match="colour"):
        read_protocol(path)
    path.write_text('objects = [{name = "mug", hard = "heavy"}]\nguard = true\n')
    assert read_protocol(path) == LiftProtocol.model_validate(
        {"objects": [{"name": "mug", "hard": "heavy"}], "guard": True}
    )
