"""Rendered training frames: repeatable, varied, labelled; and the command that writes them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.cli.app import run
from slipguard.datasets.dataset_files import DataSetWriter, contact_sheet, read_backgrounds, render_dataset
from slipguard.datasets.random_shapes import composition, resized, roughened, with_neighbor
from slipguard.datasets.samples import BROAD_NAME, COMPOSITION_NAME, UNIT_FRAMES, RenderedSample, render_sample
from slipguard.errors import InputError
from slipguard.sim.catalogue import object_names
from slipguard.sim.contact_label import label
from slipguard.sim.height_raster import FLOOR_MM, height_raster_of
from slipguard.tools.parallel import Workers


def equal(a: RenderedSample, b: RenderedSample) -> bool:
    return (
        np.array_equal(a.image, b.image)
        and np.array_equal(a.background, b.background)
        and np.array_equal(a.truth.displacement_mm, b.truth.displacement_mm)
        and a.view == b.view
    )


def real_ones() -> list[NDArray[np.uint8]]:
    return [np.full((320, 240, 3), level, np.uint8) for level in (60, 100)]


@pytest.fixture(scope="module")
def many() -> list[RenderedSample]:
    return [render_sample(seed) for seed in range(0, 400, 4)]


def test_a_seed_gives_the_same_frame_regardless_of_earlier_draws() -> None:
    first = render_sample(12)
    render_sample(13)  # of the same unit
    assert equal(first, render_sample(12))
    for other in (13, 12 + 5 * UNIT_FRAMES, 900, 1300, 1700):
        render_sample(other)
    assert equal(first, render_sample(12))
    assert not equal(first, render_sample(13))


def test_equal_lists_of_backgrounds_give_equal_frames() -> None:
    assert equal(render_sample(70, real_ones()), render_sample(70, real_ones()))


@pytest.mark.campaign
def test_the_manifest_describes_the_frames(many: list[RenderedSample]) -> None:
    for drawn in many:
        for image in (drawn.image, drawn.background):
            assert image.shape == (320, 240, 3)
            assert image.dtype == np.uint8
        assert drawn.has_contact == bool(label(drawn.truth).any())
        if drawn.view.depth_mm <= 0:
            assert not drawn.has_contact


def test_frames_are_varied(many: list[RenderedSample]) -> None:
    names = {drawn.view.object_name for drawn in many if drawn.has_contact}
    assert COMPOSITION_NAME in names
    assert len(names) > 20
    assert 0.08 < np.mean([not drawn.has_contact for drawn in many]) < 0.25
    masks = [label(drawn.truth) for drawn in many if drawn.has_contact]
    clipped = [mask[0].any() or mask[-1].any() or mask[:, 0].any() or mask[:, -1].any() for mask in masks]
    assert 0.2 < np.mean(clipped) < 0.7
    moving = np.mean([drawn.view.rate_deg_s != 0 for drawn in many if drawn.has_contact])
    assert 0.2 < moving < 0.5
    depths = [drawn.view.depth_mm for drawn in many if drawn.has_contact]
    assert min(depths) < 0.2
    assert max(depths) > 1.2


def test_without_contact_a_frame_is_its_background_but_for_light_and_wear(many: list[RenderedSample]) -> None:
    for drawn in many:
        if not drawn.has_contact and drawn.view.depth_mm <= 0:
            off = cv2.blur(drawn.image.astype(np.float32) - drawn.background, (15, 15))
            assert float(np.abs(np.median(off, axis=(0, 1))).max()) < 20


def test_training_frames_never_show_a_test_object(many: list[RenderedSample]) -> None:
    shown = {drawn.view.object_name for drawn in many} - {COMPOSITION_NAME, BROAD_NAME, ""}
    assert shown <= set(object_names("train"))
    tested = {render_sample(seed, None, "test").view.object_name for seed in range(60)} - {""}
    assert tested <= set(object_names("test"))


def test_compositions_are_surfaces() -> None:
    for seed in range(20):
        raster = composition(np.random.default_rng(seed))
        assert raster.fine.dtype == np.float32
        assert float(raster.fine.max()) == pytest.approx(0.0, abs=1e-5)
        assert float(raster.fine.min()) >= FLOOR_MM


def test_a_resized_surface_is_larger_and_a_rough_one_rough() -> None:
    ring = height_raster_of("nut")
    to_object = np.array([[0.1, 0.0, -12.0], [0.0, -0.1, 12.0]])
    area = (ring.posed(to_object, (240, 240)) > -0.1).sum()
    larger = (resized(ring, 1.5).posed(to_object, (240, 240)) > -0.1).sum()
    assert larger == pytest.approx(1.5**2 * area, rel=0.03)
    rough = roughened(ring, np.random.default_rng(0), 0.05).fine - ring.fine
    assert 0.02 < rough.std() < 0.08


def test_two_bodies_side_by_side_are_both_there() -> None:
    bead = height_raster_of("bead")
    pair = with_neighbor(bead, bead, np.random.default_rng(3))
    count, _ = cv2.connectedComponents((pair.fine > -0.8).astype(np.uint8))
    assert count == 3  # two and the ground
    assert float(pair.fine.max()) == pytest.approx(float(bead.fine.max()), abs=0.02)


def test_the_command_writes_a_data_set(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder, sheet = tmp_path / "frames", tmp_path / "sheet.png"
    command = ["dataset", "render", "--out", str(folder), "--count", "6", "--split", "test", "--show", str(sheet)]
    assert run(command) == 0
    assert "6 frames" in capsys.readouterr().out
    lines = [json.loads(line) for line in (folder / "manifest.jsonl").read_text().splitlines()]
    assert [line["file"] for line in lines] == [f"{index:06d}.png" for index in range(6)]
    for index, line in enumerate(lines):
        mask = cv2.imread(str(folder / "masks" / line["file"]), cv2.IMREAD_UNCHANGED)
        image = cv2.imread(str(folder / "images" / line["file"]))
        assert mask is not None
        assert image is not None
        assert set(np.unique(mask)) <= {0, 255}
        assert bool(mask.any()) == line["has_contact"]
        assert np.array_equal(image, render_sample(index, None, "test").image)
    overview = cv2.imread(str(sheet))
    assert overview is not None
    assert overview.shape == (480, 720, 3)


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--count", "0"], "--count"),
        (["--count", "-3"], "--count"),
        (["--count", "2", "--seed", "-1"], "--seed"),
        (["--count", "2", "--backgrounds", "nowhere"], "not a folder"),
    ],
)
def test_misuse_is_one_line_and_exit_code_2(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str], complaint: str
) -> None:
    assert run(["dataset", "render", "--out", str(tmp_path / "new"), *options]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert complaint in lines[0]
    assert not (tmp_path / "new").exists()


def test_a_folder_with_something_in_it_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(InputError, match="not an empty folder"):
        render_dataset(tmp_path, 1)
    assert [path.name for path in tmp_path.iterdir()] == ["notes.txt"]
    with pytest.raises(InputError, match="not an empty folder"):
        render_dataset(tmp_path / "notes.txt", 1)


def test_a_folder_that_cannot_be_written_is_an_input_error(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        render_dataset(tmp_path / "file" / "below", 1)


def test_two_processes_write_the_same_data_set_as_one(tmp_path: Path) -> None:
    for jobs in (1, 2):
        render_dataset(tmp_path / str(jobs), 4, seed=48, workers=Workers(jobs))  # the unit changes after two
    files = sorted(path.relative_to(tmp_path / "1") for path in (tmp_path / "1").rglob("*.*"))
    assert len(files) == 13
    for file in files:
        assert (tmp_path / "1" / file).read_bytes() == (tmp_path / "2" / file).read_bytes()


def test_backgrounds_that_cannot_be_used_are_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no image"):
        read_backgrounds(tmp_path)
    (tmp_path / "a.png").write_bytes(b"not an image")
    with pytest.raises(InputError, match=r"a\.png: not a decodable image"):
        read_backgrounds(tmp_path)
    (tmp_path / "a.png").write_bytes(b"")
    with pytest.raises(InputError, match=r"a\.png: the file is empty"):
        read_backgrounds(tmp_path)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((240, 320, 3), np.uint8))
    with pytest.raises(InputError, match=r"320 wide x 240 high"):
        read_backgrounds(tmp_path)
    cv2.imwrite(str(tmp_path / "a.png"), np.zeros((320, 240), np.uint8))
    assert [image.shape for image in read_backgrounds(tmp_path)] == [(320, 240, 3)]


def test_a_sheet_needs_a_data_set(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no data set"):
        contact_sheet(tmp_path, tmp_path / "sheet.png")


def test_a_disk_that_fills_up_leaves_nothing_behind(tmp_path: Path) -> None:
    """The manifest's last lines are written when it is closed."""
    writer = DataSetWriter(tmp_path / "set")
    writer._manifest.close()
    writer._manifest = open("/dev/full", "w", encoding="utf-8")  # noqa: SIM115 - the writer closes it
    with pytest.raises(InputError, match="No space left on device"), writer:
        writer.add({}, np.zeros((320, 240), np.uint8), {"images": b"png"})
    assert list((tmp_path / "set").iterdir()) == []
