"""Folders of images and masks become data sets, or are refused in one line."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from command_line import slipguard
from numpy.typing import NDArray

from slipguard.datasets.dataset_files import data_set_pairs
from slipguard.datasets.importer import ImportResult, found_pairs, import_dataset
from slipguard.errors import InputError

Image = NDArray[np.uint8]


def gel_image(width: int = 240, height: int = 320) -> Image:
    """Colors that differ between up and down, left and right."""
    x, y = np.meshgrid(np.linspace(0, 255, width), np.linspace(0, 255, height))
    return np.dstack([x, y, np.full_like(x, 60)]).astype(np.uint8)


def disc(width: int = 240, height: int = 320, value: int = 255) -> Image:
    """A disc in the upper left quarter."""
    mask = np.zeros((height, width), np.uint8)
    cv2.circle(mask, (width // 4, height // 4), min(width, height) // 6, (value,), -1)
    return mask


def put(path: Path, image: Image) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image)


def imported(tmp_path: Path, **options: bool) -> tuple[ImportResult, list[tuple[Image, Image]]]:
    out = tmp_path / "out"
    done = import_dataset(tmp_path / "in", out, **options)  # type: ignore[arg-type]
    pairs = []
    for image_path, mask_path in data_set_pairs(out):
        image, mask = cv2.imread(str(image_path)), cv2.imread(str(mask_path), cv2.IMREAD_UNCHANGED)
        assert image is not None
        assert mask is not None
        assert image.shape == (320, 240, 3)
        assert mask.shape == (320, 240)
        assert set(np.unique(mask)) <= {0, 255}
        pairs.append((np.asarray(image, np.uint8), np.asarray(mask, np.uint8)))
    return done, pairs


@pytest.mark.parametrize(
    ("image", "mask"),
    [
        ("images/a.png", "masks/a.png"),
        ("train/images/a.png", "train/labels/a.png"),
        ("a.png", "a_mask.png"),
        ("a.png", "masks/a.png"),
        ("Images/a.png", "Masks/a_MASK.png"),
        ("imgs/a.jpg", "gt/a.png"),
        ("JPEGImages/a.png", "SegmentationClass/a.png"),
    ],
)
def test_the_usual_layouts_are_understood(tmp_path: Path, image: str, mask: str) -> None:
    put(tmp_path / "in" / image, gel_image())
    put(tmp_path / "in" / mask, disc())
    done, pairs = imported(tmp_path)
    assert done == ImportResult(1, 0, 0, ())
    assert np.array_equal(pairs[0][1], disc())
    line = json.loads((tmp_path / "out" / "manifest.jsonl").read_text())
    assert line["source"] == image
    assert line["has_contact"] is True
    assert line["contact_share"] == pytest.approx((disc() > 0).mean(), abs=1e-5)


def test_frames_of_two_splits_do_not_mix(tmp_path: Path) -> None:
    for split, value in (("train", 255), ("val", 0)):
        put(tmp_path / "in" / split / "images" / "a.png", gel_image())
        put(tmp_path / "in" / split / "masks" / "a.png", disc(value=value))
    _, pairs = imported(tmp_path)
    assert [bool(mask.any()) for _, mask in pairs] == [True, False]


@pytest.mark.parametrize(
    "mask", [disc(value=1), np.dstack([disc() * 0, disc(), disc() * 0]), disc().astype(np.uint16) * 257]
)
def test_masks_of_ones_of_one_colour_or_of_sixteen_bits(tmp_path: Path, mask: Image) -> None:
    put(tmp_path / "in" / "a.png", gel_image())
    put(tmp_path / "in" / "a_mask.png", mask)
    _, pairs = imported(tmp_path)
    assert np.array_equal(pairs[0][1], disc())


def test_other_sizes_are_fitted(tmp_path: Path) -> None:
    put(tmp_path / "in" / "large.png", gel_image(480, 640))
    put(tmp_path / "in" / "large_mask.png", disc(120, 160))
    put(tmp_path / "in" / "side.png", np.ascontiguousarray(np.rot90(gel_image(), -1)))
    put(tmp_path / "in" / "side_mask.png", np.ascontiguousarray(np.rot90(disc(), -1)))
    put(tmp_path / "in" / "square.png", gel_image(256, 256))
    put(tmp_path / "in" / "square_mask.png", disc(256, 256))
    done, pairs = imported(tmp_path)
    assert done == ImportResult(3, 1, 1, ())
    wanted = disc() > 0
    for image, mask in pairs[:2]:
        assert np.abs(image.astype(int) - gel_image()).max() <= 2
        assert np.count_nonzero((mask > 0) != wanted) < 0.04 * wanted.sum()  # one of them was of a quarter's size
    assert pairs[2][1][80, 60] == 255  # the middle of the disc stays where it is, measured in widths and heights


def test_frames_without_contact_are_kept(tmp_path: Path) -> None:
    put(tmp_path / "in" / "a.png", gel_image())
    put(tmp_path / "in" / "a_mask.png", disc(value=0))
    imported(tmp_path)
    assert json.loads((tmp_path / "out" / "manifest.jsonl").read_text())["has_contact"] is False


def spoilt(folder: Path, kind: str) -> None:
    """Three good pairs, and something wrong with what is called b."""
    for name in ("a", "b", "c"):
        put(folder / "images" / f"{name}.png", gel_image())
        put(folder / "masks" / f"{name}.png", disc())
    image, mask = folder / "images" / "b.png", folder / "masks" / "b.png"
    if kind == "cut":
        image.write_bytes(image.read_bytes()[:2000])
    elif kind == "no mask":
        mask.unlink()
    elif kind == "no image":
        image.unlink()
    elif kind == "empty mask file":
        mask.write_bytes(b"")
    elif kind == "gray image":
        put(image, disc())
    elif kind == "another shape":
        put(mask, disc(320, 240))
    elif kind == "many values":
        put(mask, gel_image()[..., 0])


@pytest.mark.parametrize(
    ("kind", "message"),
    [
        ("cut", r"b\.png: the PNG is truncated"),
        (
            "no mask",
            r"images/b\.png: no mask \(1 unpaired file, 2 complete pairs\); add the missing files or use --skip",
        ),
        ("no image", r"masks/b\.png: no image"),
        ("empty mask file", r"masks/b\.png: the file is empty"),
        ("gray image", r"images/b\.png: gray image. Color is needed"),
        ("another shape", r"masks/b\.png: 320x240, its image 240x320"),
        ("many values", r"masks/b\.png: values 0, 1, 2.*0 and 1, or 0 and 255"),
    ],
)
def test_unusable_files_are_named_and_can_be_skipped(tmp_path: Path, kind: str, message: str) -> None:
    spoilt(tmp_path / "in", kind)
    with pytest.raises(InputError, match=message):
        import_dataset(tmp_path / "in", tmp_path / "out")
    assert not (tmp_path / "out" / "manifest.jsonl").exists()
    done, pairs = imported(tmp_path, skip=True)
    assert len(pairs) == 2
    assert len(done.left_out) == 1


def test_folders_without_usable_pairs_are_rejected(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="not a folder"):
        found_pairs(tmp_path / "nowhere")
    with pytest.raises(InputError, match="0 images and 0 masks"):
        found_pairs(tmp_path)
    for name in ("images", "backgrounds", "masks"):
        (tmp_path / "own" / name).mkdir(parents=True)
    (tmp_path / "own" / "manifest.jsonl").touch()
    with pytest.raises(InputError, match="already a data set of slipguard"):
        found_pairs(tmp_path / "own")
    put(tmp_path / "masks" / "a.png", disc())
    put(tmp_path / "images" / "b.png", gel_image())
    with pytest.raises(InputError, match="1 images and 1 masks, but no pair"):
        found_pairs(tmp_path)
    put(tmp_path / "a.png", gel_image())
    put(tmp_path / "images" / "a.png", gel_image())
    with pytest.raises(InputError, match="have the same name"):
        found_pairs(tmp_path)


def test_the_commands_import_and_show(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    for name in ("a", "b"):
        put(tmp_path / "in" / "images" / f"{name}.png", gel_image(480, 640))
        put(tmp_path / "in" / "masks" / f"{name}.png", disc(480, 640))
    put(tmp_path / "flat.png", gel_image())
    done = slipguard(
        capfd, "dataset", "import", tmp_path / "in", "--out", tmp_path / "out", "--background", tmp_path / "flat.png"
    )
    assert done.code == 0, done.err
    assert done.out.startswith("2 frames in ")
    assert (tmp_path / "out" / "backgrounds" / "000001.png").is_file()
    assert slipguard(capfd, "dataset", "show", tmp_path / "out", "--out", tmp_path / "sheet.png").code == 0
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet is not None
    assert sheet.shape == (480, 240, 3)
    again = slipguard(capfd, "dataset", "import", tmp_path / "in", "--out", tmp_path / "out")
    assert "not an empty folder" in again.complaint
    assert "no data set" in slipguard(capfd, "dataset", "show", tmp_path, "--out", tmp_path / "s.png").complaint
