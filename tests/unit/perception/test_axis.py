"""Four estimators of the axis rotate with the patch, are unbiased at the frame's edge, or decline."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_masks import SHAPES, drawn
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.estimate import AxisEstimate
from slipguard.perception.rotation.axial_angle import axial_difference_deg
from slipguard.perception.rotation.axis import (
    ESTIMATORS,
    FUSED_ESTIMATORS,
    LINE_SIGMA_MAX_DEG,
    estimate_axis,
    fuse_axes,
)
from slipguard.stress.mask_families import RANDOM
from slipguard.stress.product_functions import ProductFunctions
from slipguard.stress.trial_family import FamilyResults, generator

ALL = (*ESTIMATORS, "fused")


ELONGATED = ("bar", "rectangle", "ellipse", "key", "wedge")


def axis_by(patch: Patch, name: str) -> AxisEstimate:
    if name == "fused":
        return fuse_axes([estimate_axis(patch, each) for each in FUSED_ESTIMATORS])
    return estimate_axis(patch, name)


def patch_of(probability: NDArray[np.float32]) -> Patch:
    patch = find_patch(probability, 0.5, 100, 2.0)
    assert patch is not None
    return patch


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("shape", ["bar", "key"])
def test_angles_are_counter_clockwise_with_zero_to_the_right(name: str, shape: str) -> None:
    coarse = 2.0 if name == "skeleton" else 1.0  # large patches are thinned at half the resolution
    for angle in (-80, -45, -10, 0, 30, 60, 90):
        found = axis_by(patch_of(drawn(shape, angle)), name)
        assert found.angle_deg is not None, found
        assert -90.0 < found.angle_deg <= 90.0
        assert abs(axial_difference_deg(found.angle_deg, angle)) < 0.8 * coarse
        if shape == "bar":
            assert found.center_px == pytest.approx((120.5, 160.5), abs=coarse)


@given(st.sampled_from(ELONGATED), st.floats(-90, 90), st.floats(-90, 90), st.integers(0, 99))
def test_the_axis_rotates_with_the_patch(shape: str, before: float, rotation: float, seed: int) -> None:
    here = patch_of(drawn(shape, before, ragged_px=0.3, seed=seed))
    there = patch_of(drawn(shape, before + rotation, (58, 82), ragged_px=0.3, seed=seed + 1))
    for name in ALL:
        a, b = axis_by(here, name), axis_by(there, name)
        if a.angle_deg is None or b.angle_deg is None or a.sigma_deg is None or b.sigma_deg is None:
            continue
        error = abs(axial_difference_deg(b.angle_deg - a.angle_deg, rotation))
        assert error < 4.5 * np.hypot(a.sigma_deg, b.sigma_deg) + 0.3, (name, error)


@pytest.mark.parametrize("name", ["moments", "pca", "skeleton", "ellipse", "fused"])
def test_a_bar_cut_by_the_frame_is_unbiased(name: str) -> None:
    for angle in range(-75, 90, 15):
        for center in ((60, 80), (75, 95), (45, 60)):
            found = axis_by(patch_of(drawn("long bar", angle, center)), name)
            if found.angle_deg is None:
                continue
            assert abs(axial_difference_deg(found.angle_deg, angle)) < 2.0, (angle, center)
            assert found.sigma_deg is not None


def test_most_bars_cut_by_the_frame_have_an_axis() -> None:
    read = [axis_by(patch_of(drawn("long bar", angle)), "fused").angle_deg for angle in range(-75, 90, 15)]
    assert sum(angle is not None for angle in read) >= 8


@pytest.mark.parametrize("name", ALL)
@pytest.mark.parametrize("shape", ["disc", "ring", "square"])
def test_shapes_without_an_axis_are_declined(name: str, shape: str) -> None:
    for seed in range(8):
        found = axis_by(patch_of(drawn(shape, 11.0 * seed, ragged_px=0.4, seed=seed)), name)
        assert found.angle_deg is None
        assert found.sigma_deg is None
        assert found.declined


@pytest.mark.parametrize("name", ALL)
def test_a_disc_cut_by_the_frame_has_no_axis(name: str) -> None:
    for center in ((110, 80), (100, 80), (118, 80), (60, 150), (105, 150), (5, 5)):
        found = axis_by(patch_of(drawn("disc", 0, center)), name)
        assert found.declined, (center, found)


@given(hnp.arrays(np.float32, (50, 40), elements=st.floats(0, 1, width=32)), st.floats(0.2, 0.9))
def test_any_map_gives_an_axis_in_range_or_a_reason(probability: NDArray[np.float32], threshold: float) -> None:
    patch = find_patch(probability, threshold, 20, 2.0)
    if patch is None:
        return
    for name in ALL:
        found = axis_by(patch, name)
        assert (found.angle_deg is None) == (found.sigma_deg is None) == (found.declined is not None)
        if found.angle_deg is not None and found.sigma_deg is not None:
            assert -90.0 < found.angle_deg <= 90.0
            assert np.isfinite(found.sigma_deg)
            assert found.sigma_deg > 0.0
            assert name != "skeleton" or found.sigma_deg <= LINE_SIGMA_MAX_DEG


@pytest.mark.parametrize("seed", [471737, 674659])
def test_mirrored_patches_give_mirrored_axes(seed: int) -> None:
    """One without a middle line; one cut by the frame, of which every other column shows a quarter or nothing."""
    results = FamilyResults("random")
    RANDOM.begin(ProductFunctions())(generator("random", seed), seed, results)
    assert not results.failures, results.failures


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (2, 2), (3, 60), (160, 120)])
def test_degenerate_masks_give_an_axis_or_a_reason(shape: tuple[int, int]) -> None:
    probability = np.zeros((160, 120), np.float32)
    probability[: shape[0], : shape[1]] = 1.0
    patch = find_patch(probability, 0.5, 1, 2.0)
    assert patch is not None
    for name in ALL:
        found = axis_by(patch, name)
        assert (found.angle_deg is None) == (found.declined is not None)


def test_sigma_increases_as_the_patch_gets_rounder() -> None:
    sigmas = [axis_by(patch_of(drawn(s, 20)), "moments").sigma_deg for s in ("bar", "ellipse", "rectangle")]
    assert all(s is not None for s in sigmas)
    assert sigmas == sorted(sigmas, key=lambda s: s or 0.0)


def test_contradicting_axes_are_declined() -> None:
    said = [AxisEstimate("a", 10.0, 1.0, (0, 0)), AxisEstimate("b", 80.0, 1.0, (0, 0))]
    assert fuse_axes(said).declined
    agreed = fuse_axes([AxisEstimate("a", 89.0, 1.0, (0, 0)), AxisEstimate("b", -89.0, 1.0, (0, 0))])
    assert agreed.angle_deg is not None
    assert abs(agreed.angle_deg) == pytest.approx(90.0)


def test_every_elongated_shape_exists() -> None:
    assert set(ELONGATED) <= set(SHAPES)


@pytest.mark.parametrize("shape", ["bar", "rectangle", "ellipse"])
def test_ragged_contours_increase_every_sigma(shape: str) -> None:
    for seed in range(4):
        clean = find_patch(drawn(shape, 25.0), 0.5, 200, 2.0)
        rough = find_patch(drawn(shape, 25.0, ragged_px=3.0, seed=seed), 0.5, 200, 2.0)
        assert clean is not None
        assert rough is not None
        assert rough.ragged_px > 0.8
        for name in ("moments", "pca", "ellipse"):
            certain, uncertain = axis_by(clean, name).sigma_deg, axis_by(rough, name).sigma_deg
            assert certain is not None
            assert uncertain is None or uncertain > 2.0 * certain


@pytest.mark.parametrize("name", ["moments", "pca", "ellipse", "fused"])
def test_a_ring_cut_by_the_frame_has_no_axis(name: str) -> None:
    for seed, x in enumerate((8.0, 14.0, 20.0, 24.0)):
        patch = find_patch(drawn("ring", 0.0, (x, 80.0), ragged_px=0.3, seed=seed), 0.5, 200, 2.0)
        assert patch is not None
        assert patch.clipped.left
        assert axis_by(patch, name).declined
