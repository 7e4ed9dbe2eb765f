"""`slipguard measure`: exact JSON, masks at frame size, and one clear line for every file that cannot be used."""

import json
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slipguard.cli.measure import ReferenceChoice, measure
from slipguard.errors import InputError, ModelError
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit
from slipguard.tools.image_files import find_image_files, read_frames, read_gel_image

KEYS = {
    "frame",
    "contact",
    "contact_area_px",
    "angle_deg",
    "orientation_deg",
    "sigma_deg",
    "reference",
    "method",
    "skipped",
    "declined",
    "stage_ms",
}


CAMERA = GelCamera(SensorUnit(), seed=7)


def glow(seed: int) -> np.ndarray:
    """The untouched gel with camera noise, (320, 240, 3) uint8."""
    CAMERA.reseed(seed)
    return CAMERA.draw(GelView("", depth_mm=-1.0))


def bar(seed: int, rotation_deg: float) -> np.ndarray:
    """A bar pressed 0.8 mm into the gel."""
    CAMERA.reseed(seed)
    return CAMERA.draw(GelView("bar", angle_deg=rotation_deg, depth_mm=0.8))


def run(paths: list[Path], **options: Any) -> None:
    given: dict[str, Any] = {
        "background": None,
        "masks": None,
        "plot": None,
        "json": True,
        "independent": False,
        "reference": ReferenceChoice.stable,
        "model": None,
        "estimator": None,
    }
    measure(paths, **(given | options))


def lines(capsys: pytest.CaptureFixture[str]) -> list[dict[str, Any]]:
    return [json.loads(line) for line in capsys.readouterr().out.splitlines()]


@pytest.fixture
def rotating(tmp_path: Path) -> Path:
    """A folder: two frames without contact, six held still, then a rotation by 12 degrees; and the background."""
    folder = tmp_path / "frames"
    folder.mkdir()
    angles = [None, None, *[20.0] * 6, 22.0, 24.0, 26.0, 28.0, 30.0, 32.0]
    for number, angle in enumerate(angles):
        image = glow(number) if angle is None else bar(number, angle)
        cv2.imwrite(str(folder / f"f{number:02d}.png"), image)
    cv2.imwrite(str(tmp_path / "background.png"), glow(99))
    return folder


def test_a_rotation_is_measured_with_sign_and_all_keys(rotating: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run([rotating], background=rotating.parent / "background.png")
    seen = lines(capsys)
    assert all(set(line) == KEYS for line in seen)
    assert [line["frame"] for line in seen] == [f"f{n:02d}.png" for n in range(14)]
    assert [line["contact"] for line in seen] == [False] * 2 + [True] * 12
    assert seen[0]["contact_area_px"] == 0
    assert seen[0]["angle_deg"] is None
    assert seen[0]["sigma_deg"] is None
    assert seen[-1]["angle_deg"] == pytest.approx(12.0, abs=1.5)
    assert seen[-1]["sigma_deg"] > 0.0
    assert seen[-1]["orientation_deg"] == pytest.approx(32.0, abs=3.0)
    assert all(isinstance(value, float) for value in seen[-1]["stage_ms"].values())
    assert [line["declined"] for line in seen[:3]] == ["no contact", "no contact", "no reference yet"]
    assert all((line["declined"] is None) == (line["angle_deg"] is not None) for line in seen)
    first = next(line for line in seen if line["angle_deg"] is not None)
    assert [line["reference"] for line in seen if line["angle_deg"] is None] == [None] * seen.index(first)
    assert {line["reference"] for line in seen if line["angle_deg"] is not None} == {first["frame"]}


def test_reference_first_measures_from_the_first_contact(rotating: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run([rotating], background=rotating.parent / "background.png", reference=ReferenceChoice.first)
    seen = lines(capsys)
    assert seen[2]["angle_deg"] == pytest.approx(0.0, abs=0.5)
    assert seen[-1]["angle_deg"] == pytest.approx(12.0, abs=1.5)


def test_independent_frames_have_an_orientation_but_no_rotation(
    rotating: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run([rotating], background=rotating.parent / "background.png", independent=True)
    seen = lines(capsys)
    assert all(line["angle_deg"] is None for line in seen)
    assert seen[-1]["orientation_deg"] == pytest.approx(32.0, abs=3.0)
    assert all(line["skipped"] != "unchanged" for line in seen)
    assert {line["declined"] for line in seen if line["contact"]} == {"single frame: only the orientation is known"}


def test_masks_have_the_size_of_the_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    large = cv2.resize(bar(1, 20.0), (480, 640))
    cv2.imwrite(str(tmp_path / "large.png"), large)
    cv2.imwrite(str(tmp_path / "none.png"), glow(2))
    cv2.imwrite(str(tmp_path / "background.png"), glow(99))
    paths = [tmp_path / "large.png", tmp_path / "none.png"]
    run(paths, background=tmp_path / "background.png", masks=tmp_path / "masks")
    found = cv2.imread(str(tmp_path / "masks" / "large.png"), cv2.IMREAD_UNCHANGED)
    assert found.shape == (640, 480)
    assert set(np.unique(found)) == {0, 255}
    assert lines(capsys)[0]["contact_area_px"] == pytest.approx((found > 0).sum() / 4, rel=0.05)
    nothing = cv2.imread(str(tmp_path / "masks" / "none.png"), cv2.IMREAD_UNCHANGED)
    assert nothing.shape == (320, 240)
    assert not nothing.any()


def test_the_table_the_summary_and_the_plot_are_written(rotating: Path, capsys: pytest.CaptureFixture[str]) -> None:
    plot = rotating.parent / "rotation.png"
    run([rotating], background=rotating.parent / "background.png", json=False, plot=plot)
    message = capsys.readouterr()
    assert "14 frames, 12 with contact" in message.out
    assert message.err == ""
    drawn = cv2.imread(str(plot))
    assert drawn.shape[0] > 300
    assert drawn.std() > 5.0


def test_the_table_is_complete_at_80_columns(
    rotating: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    name = "20261121T143012.250Z_left_finger_005.png"
    (rotating / "f05.png").rename(rotating / name)
    run([rotating / name], background=rotating.parent / "background.png", json=False)
    lines = capsys.readouterr().out.splitlines()
    assert max(map(len, lines)) <= 80
    assert name in "".join(line.split(" ", 1)[0] for line in lines[3:])
    assert not [line for line in lines if "…" in line]


@pytest.mark.parametrize(("estimator", "method"), [(None, "moments"), ("pca", "pca")])
def test_without_a_background_the_rotation_is_that_of_the_axis(
    estimator: str | None, method: str, rotating: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run([rotating], estimator=estimator)
    message = capsys.readouterr()
    assert f"the rotation is that of the mask's axis ({method})" in message.err
    assert message.err.count("\n") == 1
    last = json.loads(message.out.splitlines()[-1])
    assert last["contact"] is True
    assert last["method"] == method
    assert last["angle_deg"] == pytest.approx(12.0, abs=4.0 * last["sigma_deg"])


def test_registration_without_a_background_is_refused(rotating: Path) -> None:
    with pytest.raises(InputError, match="add --background"):
        run([rotating], estimator="registration")


def test_a_video_is_read_frame_by_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "grasp.avi"
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"MJPG"), 30.0, (240, 320))
    for number in range(4):
        writer.write(bar(number, 20.0))
    writer.release()
    run([path])
    assert [line["frame"] for line in lines(capsys)] == [f"grasp-{n:06d}" for n in range(4)]


def image_bytes(image: np.ndarray, ending: str = ".png") -> bytes:
    return cv2.imencode(ending, image)[1].tobytes()


def damaged_png() -> bytes:
    data = bytearray(image_bytes(bar(0, 20.0)))
    data[len(data) // 2] ^= 0xFF
    return bytes(data)


def progressive_jpeg() -> bytes:
    return cv2.imencode(".jpg", bar(0, 20.0), [cv2.IMWRITE_JPEG_PROGRESSIVE, 1])[1].tobytes()


with_alpha = np.dstack([bar(0, 20.0), np.full((320, 240), 128, np.uint8)])
BAD = {
    "empty": (b"", "empty"),
    "truncated PNG": (image_bytes(bar(0, 20.0))[:5000], "truncated"),
    "truncated JPEG": (image_bytes(bar(0, 20.0), ".jpg")[:3000], "truncated"),
    "truncated JPEG with an end": (image_bytes(bar(0, 20.0), ".jpg")[:3000] + b"\xff\xd9", "truncated"),
    "truncated progressive JPEG with an end": (progressive_jpeg()[:-400] + b"\xff\xd9", "truncated"),
    "damaged PNG": (damaged_png(), "checksum"),
    "GIF": (image_bytes(bar(0, 20.0), ".gif"), "neither PNG, JPEG, BMP, TIFF nor WebP"),
    "text": (b"not an image at all", "not a decodable image"),
    "1x1": (image_bytes(np.full((1, 1, 3), (9, 90, 200), np.uint8)), "1x1"),
    "16-bit": (image_bytes(bar(0, 20.0).astype(np.uint16) * 256), "16 bits"),
    "gray": (image_bytes(bar(0, 20.0)[..., 1]), "gray image"),
    "gray as color": (image_bytes(np.repeat(bar(0, 20.0)[..., 1:2], 3, 2)), "all channels are equal"),
    "transparent": (image_bytes(with_alpha), "transparent"),
    "4K": (image_bytes(cv2.resize(bar(0, 20.0), (3840, 2160))), "3840x2160"),
    "rotated by 90 degrees": (image_bytes(cv2.transpose(bar(0, 20.0))), "Transpose the image"),
    "too small": (image_bytes(cv2.resize(bar(0, 20.0), (120, 160))), "120x160"),
    "all black": (image_bytes(np.zeros((320, 240, 3), np.uint8)), "all black"),
    "all white": (image_bytes(np.full((320, 240, 3), 255, np.uint8)), "all white"),
}


@pytest.mark.parametrize("kind", BAD)
def test_a_bad_file_is_named_in_one_line_and_earlier_results_are_kept(
    kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    data, message = BAD[kind]
    cv2.imwrite(str(tmp_path / "a.png"), bar(0, 20.0))
    (tmp_path / "b.png").write_bytes(data)
    with pytest.raises(InputError, match=message) as caught:
        run([tmp_path], masks=tmp_path / "masks")
    assert str(tmp_path / "b.png") in str(caught.value)
    assert "\n" not in str(caught.value)
    out, err = capfd.readouterr()
    assert [json.loads(line)["frame"] for line in out.splitlines()] == ["a.png"]
    assert err.count("\n") == 1, "libraries must not add lines of their own"
    assert (tmp_path / "masks" / "a.png").is_file()


def test_a_frame_is_named_as_its_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Brackets are no markup of the table."""
    (tmp_path / "a[red]b[bold].png").write_bytes(image_bytes(bar(0, 20.0)))
    run([tmp_path / "a[red]b[bold].png"], json=False)
    assert "a[red]b[bold].png" in capsys.readouterr().out


def test_opaque_alpha_is_dropped(tmp_path: Path) -> None:
    image = bar(0, 20.0)
    path = tmp_path / "alpha.png"
    cv2.imwrite(str(path), np.dstack([image, np.full((320, 240), 255, np.uint8)]))
    np.testing.assert_array_equal(read_gel_image(path), image)


def test_a_folder_stands_for_its_images_by_name(tmp_path: Path) -> None:
    for name in ("f10.png", "f2.png", "f1.png", "notes.txt"):
        (tmp_path / name).write_bytes(image_bytes(bar(0, 20.0)))
    assert [path.name for path in find_image_files([tmp_path])] == ["f1.png", "f10.png", "f2.png"]


def test_a_folder_without_images_is_refused(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(InputError, match="no image in this folder"):
        run([tmp_path])


@pytest.mark.parametrize(("name", "message"), [("gone.png", "no such file"), ("notes.txt", "unknown file type")])
def test_other_paths_are_refused(tmp_path: Path, name: str, message: str) -> None:
    (tmp_path / "notes.txt").write_text("nothing here")
    with pytest.raises(InputError, match=message):
        run([tmp_path / name])


@pytest.mark.parametrize("data", [b"", b"not a video at all"])
def test_an_invalid_video_is_refused(tmp_path: Path, data: bytes) -> None:
    path = tmp_path / "clip.mp4"
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"clip\.mp4"):
        list(read_frames([path]))


def test_equal_stems_would_overwrite_masks(tmp_path: Path) -> None:
    for ending in ("png", "jpg"):
        cv2.imwrite(str(tmp_path / f"a.{ending}"), bar(0, 20.0))
    with pytest.raises(InputError, match=r"would both write a\.png"):
        run([tmp_path], masks=tmp_path / "masks")


def test_unknown_estimator_and_model_are_refused(rotating: Path) -> None:
    with pytest.raises(InputError, match="did you mean 'moments'"):
        run([rotating], estimator="moment")
    with pytest.raises(ModelError, match="no such file"):
        run([rotating], model=rotating / "none.onnx")


@pytest.mark.parametrize("path", [Path("/dev/null"), Path()], ids=["device", "folder"])
def test_only_a_file_is_read_as_an_image(path: Path) -> None:
    """A device such as /dev/zero never ends."""
    with pytest.raises(InputError, match=r"not an image file\. Give an 8-bit color PNG or JPEG"):
        read_gel_image(path)
