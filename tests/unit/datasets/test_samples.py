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
from slipguard.datasets.samples import (
    BROAD_NAME,
    COMPOSITION_NAME,
    UNIT_FRAMES,
    RenderedSample,
    render_presses,
    render_samples,
)
from slipguard.errors import InputError
from slipguard.sim.catalogue import object_names
from slipguard.sim.contact_label import label
from slipguard.tools.parallel import Workers


def render_sample(
    seed: int, backgrounds: list[NDArray[np.uint8]] | None = None, split: str = "train"
) -> RenderedSample:
    return next(render_samples(range(seed, seed + 1), backgrounds, split))


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
        assert drawn.has_contact == bool(label(drawn.truth).any())
        if drawn.view.depth_mm <= 0:
            assert not drawn.has_contact
            off = cv2.blur(drawn.image.astype(np.float32) - drawn.background, (15, 15))
            assert float(np.abs(np.median(off, axis=(0, 1))).max()) < 20


def test_training_frames_never_show_a_test_object(many: list[RenderedSample]) -> None:
    shown = {drawn.view.object_name for drawn in many} - {COMPOSITION_NAME, BROAD_NAME, ""}
    assert shown <= set(object_names("train"))
    tested = {render_sample(seed, None, "test").view.object_name for seed in range(60)} - {""}
    assert tested <= set(object_names("test"))


def test_presses_show_the_given_objects_in_turn_and_always_touch() -> None:
    names = ("nut", "gear")
    drawn = list(render_presses(names, range(UNIT_FRAMES - 2, UNIT_FRAMES + 2)))
    assert [one.view.object_name for one in drawn] == [*names, *names]
    assert all(label(one.truth).any() for one in drawn)


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
