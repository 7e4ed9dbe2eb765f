"""Which regions form the contact patch, and where the frame cuts it."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from drawn_masks import drawn
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from skimage.measure import label, regionprops

from slipguard.perception.patch import find_patch


def disc(*spots: tuple[int, int, int]) -> NDArray[np.float32]:
    image = np.zeros((160, 120), np.float32)
    for x, y, radius in spots:
        cv2.circle(image, (x, y), radius, 1.0, -1)
    return image


def test_nothing_above_the_threshold_is_no_contact() -> None:
    assert find_patch(np.full((160, 120), 0.4, np.float32), 0.5, 200, 2.0) is None


def test_a_small_region_is_no_contact() -> None:
    assert find_patch(disc((60, 80, 3)), 0.5, 200, 2.0) is None


def test_area_and_position_equal_those_of_scikit_image() -> None:
    probability = drawn("key", 33, (55, 90))
    patch = find_patch(probability, 0.5, 200, 2.0)
    assert patch is not None
    (region,) = regionprops(label(probability > 0.5))
    assert patch.area_px == 4 * region.area
    m = cv2.moments(patch.mask, True)
    x, y = patch.to_frame(m["m10"] / m["m00"], m["m01"] / m["m00"])
    assert (x, y) == pytest.approx((2 * region.centroid[1] + 0.5, 2 * region.centroid[0] + 0.5), abs=1e-6)
    np.testing.assert_array_equal(patch.full_mask(), probability > 0.5)


@pytest.mark.parametrize(
    ("spots", "regions"),
    [
        (((40, 80, 14), (80, 80, 13)), 2),  # two pins of one size
        (((50, 80, 20), (85, 80, 9)), 2),  # a smaller part
        (((50, 80, 20), (85, 80, 6)), 1),  # a speck
    ],
)
def test_all_but_small_regions_form_one_patch(spots: tuple[tuple[int, int, int], ...], regions: int) -> None:
    patch = find_patch(disc(*spots), 0.5, 100, 2.0)
    assert patch is not None
    assert cv2.connectedComponents(patch.mask)[0] - 1 == regions


def test_clipped_sides_are_reported() -> None:
    patch = find_patch(drawn("long bar", 90, (10, 80)), 0.5, 200, 2.0)
    assert patch is not None
    sides = patch.clipped
    assert (sides.left, sides.top, sides.right, sides.bottom) == (True, True, False, True)
    inside = find_patch(drawn("bar", 20), 0.5, 200, 2.0)
    assert inside is not None
    assert not inside.clipped.any


def test_probability_far_from_the_patch_is_left_out() -> None:
    haze = np.maximum(drawn("bar", 45), np.float32(0.3))
    patch = find_patch(haze, 0.5, 200, 2.0)
    assert patch is not None
    assert patch.probability[0, 0] == 0.0
    assert not patch.probability.flags.writeable


def test_a_region_in_which_the_network_is_unsure_is_no_contact() -> None:
    glow = np.float32(0.7) * disc((60, 80, 30))
    assert find_patch(glow, 0.5, 200, 2.0) is None
    contact = disc((60, 120, 15))
    patch = find_patch(np.maximum(np.float32(0.7) * disc((60, 40, 25)), contact), 0.5, 200, 2.0)
    assert patch is not None
    assert patch.area_px == 4 * np.count_nonzero(contact > 0.5)


@given(
    hnp.arrays(np.float32, (40, 30), elements=st.floats(-1, 2, width=32) | st.just(np.float32(np.nan))),
    st.floats(0.05, 0.95),
)
def test_any_map_gives_a_patch_or_none(probability: NDArray[np.float32], threshold: float) -> None:
    patch = find_patch(probability, threshold, 20, 2.0)
    if patch is not None:
        assert np.isfinite(patch.probability).all()
        assert patch.area_px >= 20
        assert set(np.unique(patch.mask)) <= {0, 1}


@pytest.mark.parametrize("beyond", [3e38, -3e38, np.inf, -np.inf, np.nan])
def test_probabilities_beyond_0_and_1_are_clipped(beyond: float) -> None:
    clean = drawn("bar", 30.0)
    spoiled = clean.copy()
    spoiled[np.random.default_rng(0).random(clean.shape) < 0.02] = beyond
    patch, whole = (find_patch(one, 0.5, 200, 2.0) for one in (spoiled, clean))
    assert patch is not None
    assert whole is not None
    assert patch.probability.min() >= 0.0
    assert patch.probability.max() <= 1.0
    assert patch.center_px == pytest.approx(whole.center_px, abs=1.0)
