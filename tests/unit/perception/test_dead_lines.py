"""Dead lines of the sensor are found in the background image, and hide neither a contact nor its rotation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.errors import FrameCorrupt
from slipguard.perception.background import DeadLines
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.sensor_unit import random_unit
from slipguard.stress.grasps import Image, rotated_grasp
from slipguard.stress.image_distortions import DISTORTIONS
from slipguard.stress.run import cases
from slipguard.stress.trial import ProductFunctions, run_trial

ROWS, COLUMNS = {0: 250, 71: 0, 72: 0, 200: 90, 319: 40}, {5: 30, 150: 180, 239: 0}


def with_lines(image: Image) -> Image:
    out = image.copy()
    for row, level in ROWS.items():
        out[row] = level
    for column, level in COLUMNS.items():
        out[:, column] = level
    return out


def test_dead_lines_are_found_and_interpolated() -> None:
    sound = rotated_grasp(3).background
    lines = DeadLines(with_lines(sound))
    assert lines.rows == list(ROWS)
    assert lines.columns == list(COLUMNS)
    spoiled = with_lines(sound)
    whole = lines.interpolate(spoiled)
    off = np.abs(whole.astype(np.int16) - sound)
    assert off.mean() < 0.5
    assert np.percentile(off[[*ROWS]], 99) <= 12
    assert np.array_equal(np.delete(np.delete(whole, [*ROWS], 0), [*COLUMNS], 1),
                          np.delete(np.delete(sound, [*ROWS], 0), [*COLUMNS], 1))  # fmt: skip
    assert np.array_equal(spoiled, with_lines(sound))  # a driver's own frame is left alone
    assert np.array_equal(lines.interpolate(whole), whole)


@pytest.mark.parametrize("unit", range(6))
def test_a_healthy_unit_has_none_and_its_frames_are_not_copied(unit: int) -> None:
    no_contact = GelCamera(random_unit(np.random.default_rng(unit)), seed=unit).no_contact()
    lines = DeadLines(no_contact)
    assert (lines.rows, lines.columns) == ([], [])
    assert lines.interpolate(no_contact) is no_contact


@pytest.mark.parametrize("spoil", sorted(set(DISTORTIONS) - {"dead lines"}))
@pytest.mark.parametrize("strength", [0.03, 0.25, 1.0])
def test_other_distortions_are_not_taken_for_dead_lines(spoil: str, strength: float) -> None:
    lines = DeadLines(DISTORTIONS[spoil](rotated_grasp(1).background, strength, np.random.default_rng(4)))
    assert (lines.rows, lines.columns) == ([], [])


def test_an_image_of_lines_only_is_left_unchanged() -> None:
    striped = np.repeat(np.arange(320, dtype=np.uint8)[:, None, None] % 2 * 200, 240, axis=1).repeat(3, axis=2)
    assert DeadLines(striped).rows == []
    assert DeadLines(None).interpolate(striped) is striped


def test_invalid_images_are_rejected_before_interpolation() -> None:
    lines = DeadLines(with_lines(rotated_grasp(3).background))
    with pytest.raises(FrameCorrupt, match="expected"):
        lines.interpolate(np.zeros((160, 120, 3), np.uint8))


def test_dead_lines_cause_no_wrong_certain_rotation() -> None:
    for case in cases(["dead lines"], 0, ProductFunctions())[:6]:
        assert not run_trial(case).failures, case


def drawn_over(image: Image) -> NDArray[np.uint8]:
    out = image.copy()
    out[::12] = 200
    cv2.line(out, (80, 0), (80, 319), (10, 10, 10), 1)
    return out


def test_a_rotation_is_measured_with_many_dead_lines_and_the_mask_has_no_gaps() -> None:
    shown = rotated_grasp(10)
    segmenter = Segmenter()
    measured = []
    for spoil in (np.copy, drawn_over):
        pipeline = Pipeline(segmenter, PerceptionSettings(), spoil(shown.background), shown.noise_bgr, 18.5)
        estimates = [pipeline.process(Frame(spoil(one), k / 60, k)) for k, one in enumerate(shown.frames)]
        assert estimates[-1].rotation_deg == pytest.approx(shown.rotations_deg[-1], abs=1.5)
        measured.append(estimates[-1])
    assert measured[1].contact_area_px == pytest.approx(measured[0].contact_area_px, rel=0.05)
