"""Computed rotations of real presses under fixed lights, and the command that measures them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
from textured_surfaces import LEVEL, LedLights, contact_map, heights, lettered, shaded_image

from slipguard.errors import InputError
from tests.campaigns.command_line import run
from tests.campaigns.rotated_presses import PressImage, press_images, rotated_grasp


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data set of one press, drawn: a plate with letters under three lights, and its mask."""
    root = tmp_path_factory.mktemp("real")
    home = root / "anytouch2_force2"
    (home / "frames").mkdir(parents=True)
    (home / "masks").mkdir()
    height = heights(lettered, 10.0, (120.0, 160.0), 1.0)
    rng = np.random.default_rng(3)
    still = np.full((320, 240, 3), LEVEL) + np.linspace(-20, 20, 240)[None, :, None] * np.array([1.0, 0.5, -1.0])
    image = np.clip(shaded_image(height, LedLights(), 1.0, rng) - LEVEL + still, 0, 255).astype(np.uint8)
    mask = np.where(cv2.resize(contact_map(height), (240, 320)) > 0.5, 255, 0).astype(np.uint8)
    cv2.imwrite(str(home / "background.png"), still.astype(np.uint8))
    for name in ("f0012.png", "f0140.png"):
        cv2.imwrite(str(home / "frames" / name), image)
        cv2.imwrite(str(home / "masks" / name), mask)
    return root


@pytest.fixture(scope="module")
def press(folder: Path) -> PressImage:
    return next(press_images(folder))


def test_a_grasp_is_the_same_for_one_seed_and_ends_without_contact(press: PressImage) -> None:
    one, again, other = (
        rotated_grasp(press, "relit", 5),
        rotated_grasp(press, "relit", 5),
        rotated_grasp(press, "relit", 6),
    )
    assert all(np.array_equal(a.frame.image, b.frame.image) for a, b in zip(one.shots, again.shots, strict=True))
    assert [shot.rotation_deg for shot in one.shots] != [shot.rotation_deg for shot in other.shots]
    assert 10.0 <= max(abs(shot.rotation_deg) for shot in one.shots) <= 30.0
    assert not one.shots[0].contact
    assert not one.shots[-1].contact
    assert sum(shot.compared for shot in one.shots) >= 12


def test_the_command_gives_both_ways(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["rotated-presses", str(folder), "--json"]) == 0
    rows = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert [(row["data"], row["way"], row["sequences"]) for row in rows] == [
        ("anytouch2_force2", "relit", 1),
        ("anytouch2_force2", "rigid", 1),
    ]
    assert all(row["mean_deg"] is None or row["mean_deg"] < 2.0 for row in rows)


def test_misuse_is_one_line(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["rotated-presses", str(tmp_path)]) == 2
    assert "neither taxim_sphere nor anytouch2_force2" in capsys.readouterr().err
    assert run(["rotated-presses", str(folder), "--part", "most"]) == 2
    assert "there are tune, test, all" in capsys.readouterr().err
    (tmp_path / "taxim_sphere").mkdir()
    cv2.imwrite(str(tmp_path / "taxim_sphere" / "background.png"), np.full((320, 240, 3), (90, 100, 110), np.uint8))
    with pytest.raises(InputError, match=r"circles\.csv: missing"):
        list(press_images(tmp_path))
