"""The label outlines what is visibly pressed: larger than the contact, smaller than the moving area, without gaps."""

import numpy as np
import pytest

from slipguard.sim.contact_label import PRESS_SHARE, label
from slipguard.sim.gel_camera import GelTruth


def truth(displacement_mm: np.ndarray, press_mm: float) -> GelTruth:
    image = np.zeros((320, 240, 3), np.uint8)
    return GelTruth(image, displacement_mm >= press_mm, displacement_mm.astype(np.float32), press_mm)


def cone(press_mm: float, slope_mm_px: float = 0.02) -> np.ndarray:
    y, x = np.mgrid[0:320, 0:240]
    return np.maximum(press_mm - slope_mm_px * np.hypot(x - 120, y - 160), 0.0)


def test_the_label_ends_where_the_displacement_reaches_the_share() -> None:
    mask = label(truth(cone(1.0), 1.0))
    radius_px = np.sqrt(mask.sum() / np.pi)
    assert mask.dtype == np.uint8
    assert radius_px == pytest.approx((1.0 - PRESS_SHARE) / 0.02, abs=1.0)


def test_gaps_between_ribs_are_closed_but_two_things_apart_stay_two() -> None:
    ribs = np.zeros((320, 240))
    ribs[100:200, 60:70] = ribs[100:200, 85:95] = 0.8
    assert label(truth(ribs, 0.8))[150, 60:95].all()
    apart = np.zeros((320, 240))
    apart[100:200, 40:60] = apart[100:200, 160:180] = 0.8
    assert not label(truth(apart, 0.8))[150, 80:140].any()


def test_a_patch_cut_by_the_frame_reaches_the_frame() -> None:
    half = np.zeros((320, 240))
    half[:, :50] = 0.8
    mask = label(truth(half, 0.8))
    assert mask[:, :50].all()
    assert not mask[:, 50:].any()


def test_nothing_visible_is_no_contact() -> None:
    assert not label(truth(np.zeros((320, 240)), 0.0)).any()
    assert not label(truth(cone(0.01), 0.01)).any()
    assert not label(truth(np.full((320, 240), 0.05), 1.0)).any(), "the skirt of something outside the image"
