"""The axis of the mask: four estimators for comparison, and the rotation where there is no background image."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_masks import drawn
from held_finger import FRAME_S, DrawnFinger, RenderedFinger
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray
from textured_surfaces import Surface, ball, plate

from slipguard.perception.axis import ESTIMATORS, SIGMA_MAX_DEG, axial_difference_deg, estimate_axis, wrap_axial_deg
from slipguard.perception.estimate import DeclineReason, Estimate
from slipguard.perception.patch import Patch, find_patch

ANY_DEG = st.floats(-1e6, 1e6)


def patch_of(probability: NDArray[np.float32]) -> Patch:
    patch = find_patch(probability, 0.5, 100, 2.0)
    assert patch is not None
    return patch


@given(ANY_DEG)
def test_an_axis_lies_in_the_half_open_range(angle: float) -> None:
    wrapped = wrap_axial_deg(angle)
    assert -90.0 < wrapped <= 90.0
    assert np.isclose(np.sin(np.radians(wrapped - angle)), 0.0, atol=1e-6)


def test_differences_of_axes_cross_90_degrees() -> None:
    assert axial_difference_deg(-80.0, 80.0) == 20.0
    assert axial_difference_deg(80.0, -80.0) == -20.0


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("shape", ["bar", "key"])
@pytest.mark.parametrize("angle_deg", [-80.0, -45.0, 0.0, 30.0, 90.0])
def test_angles_are_counter_clockwise_with_zero_to_the_right(name: str, shape: str, angle_deg: float) -> None:
    found = estimate_axis(patch_of(drawn(shape, angle_deg)), name)
    assert found.angle_deg is not None, found
    assert abs(axial_difference_deg(found.angle_deg, angle_deg)) < 0.8
    if shape == "bar":
        assert found.center_px == pytest.approx((120.5, 160.5), abs=1.0)


@given(st.sampled_from(("bar", "rectangle", "ellipse", "key", "wedge")), st.floats(-90, 90), st.integers(0, 99))
def test_errors_of_ragged_masks_are_within_sigma(shape: str, rotation_deg: float, seed: int) -> None:
    here = patch_of(drawn(shape, 20.0, ragged_px=0.3, seed=seed))
    there = patch_of(drawn(shape, 20.0 + rotation_deg, (58, 82), ragged_px=0.3, seed=seed + 1))
    for name in ESTIMATORS:
        a, b = estimate_axis(here, name), estimate_axis(there, name)
        if a.angle_deg is None or b.angle_deg is None or a.sigma_deg is None or b.sigma_deg is None:
            continue
        error_deg = abs(axial_difference_deg(b.angle_deg - a.angle_deg, rotation_deg))
        assert error_deg < 4.5 * np.hypot(a.sigma_deg, b.sigma_deg) + 0.3, name


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize(
    ("shape", "center"),
    [("disc", (60, 80)), ("ring", (60, 80)), ("square", (60, 80)), ("disc", (110, 80)), ("disc", (5, 5))],
)
def test_shapes_without_an_axis_are_declined(name: str, shape: str, center: tuple[float, float]) -> None:
    for seed in range(4):
        found = estimate_axis(patch_of(drawn(shape, 11.0 * seed, center, ragged_px=0.4, seed=seed)), name)
        assert found.declined
        assert (found.angle_deg, found.sigma_deg) == (None, None)


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_bar_cut_by_the_frame_is_unbiased_or_declined(name: str) -> None:
    for angle_deg in range(-75, 90, 15):
        for center in ((60, 80), (75, 95), (45, 60)):
            found = estimate_axis(patch_of(drawn("long bar", angle_deg, center)), name)
            if found.angle_deg is not None:
                assert abs(axial_difference_deg(found.angle_deg, angle_deg)) < 2.0, (angle_deg, center)


@pytest.mark.parametrize("name", ["moments", "pca", "ellipse"])
def test_sigma_grows_with_roundness_and_a_ragged_contour(name: str) -> None:
    sigmas = [estimate_axis(patch_of(drawn(shape, 20.0)), name).sigma_deg for shape in ("bar", "rectangle")]
    ragged = estimate_axis(patch_of(drawn("bar", 20.0, ragged_px=3.0)), name).sigma_deg
    assert sigmas[0] is not None
    assert sigmas[1] is not None
    assert sigmas[1] > 1.2 * sigmas[0]
    assert ragged is None or ragged > 2.0 * sigmas[0]


@given(hnp.arrays(np.float32, (50, 40), elements=st.floats(0, 1, width=32)), st.floats(0.2, 0.9))
def test_any_map_gives_an_axis_in_range_or_a_reason(probability: NDArray[np.float32], threshold: float) -> None:
    patch = find_patch(probability, threshold, 20, 2.0)
    if patch is None:
        return
    for name in ESTIMATORS:
        found = estimate_axis(patch, name)
        assert (found.angle_deg is None) == (found.sigma_deg is None) == (found.declined is not None)
        if found.angle_deg is not None and found.sigma_deg is not None:
            assert -90.0 < found.angle_deg <= 90.0
            assert found.sigma_deg > 0.0
            assert found.sigma_deg <= SIGMA_MAX_DEG


@pytest.mark.parametrize("shape", [(1, 40), (40, 1), (2, 2), (3, 60), (160, 120)])
@pytest.mark.parametrize("name", ESTIMATORS)
def test_degenerate_masks_give_an_axis_or_a_reason(name: str, shape: tuple[int, int]) -> None:
    probability = np.zeros((160, 120), np.float32)
    probability[: shape[0], : shape[1]] = 1.0
    patch = find_patch(probability, 0.5, 1, 2.0)
    assert patch is not None
    found = estimate_axis(patch, name)
    assert (found.angle_deg is None) == (found.declined is not None)


@pytest.mark.parametrize("name", ESTIMATORS)
@pytest.mark.parametrize("rotation_deg", [200.0, -100.0])
def test_each_estimator_follows_the_rotation_across_90_degrees(name: str, rotation_deg: float) -> None:
    finger = DrawnFinger(plate, estimator=name)
    finger.rest()
    for k in range(1, 21):
        last = finger.see(rotation_deg * k / 20)
        assert last.rotation_deg is not None, last.declined
        assert abs(last.rotation_deg - rotation_deg * k / 20) < 4.0 * (last.sigma_deg or 0.0)
    assert last.method == name


@pytest.mark.parametrize("name", ESTIMATORS)
def test_a_flipped_axis_is_not_a_rotation(name: str) -> None:
    finger = DrawnFinger(plate, estimator=name)
    finger.rest()
    flipped = finger.see(88.0)
    assert flipped.rotation_deg is None
    assert flipped.contact


def axis_only(surface: Surface, rotations_deg: list[float], gap_s: float = FRAME_S) -> list[Estimate]:
    """Return a pipeline's estimates without a background image, after a rest; the last one follows a gap."""
    finger, seen = DrawnFinger(surface, background=None), []
    for rotation_deg in [0.0] * 6 + rotations_deg:
        finger.now_s += gap_s if len(seen) == 5 + len(rotations_deg) else FRAME_S
        seen.append(finger.pipeline.process(finger.draw(rotation_deg)))
    return seen[6:]


def test_without_a_background_the_axis_is_used_and_a_gap_leaves_it_ambiguous() -> None:
    last = axis_only(plate, [5.0, 10.0, 15.0])[-1]
    assert last.rotation_deg is not None
    assert last.sigma_deg is not None
    assert last.sigma_deg > 0.5  # an axis of a mask is no texture
    assert abs(last.rotation_deg - 15.0) < last.sigma_deg
    assert axis_only(plate, [5.0, 10.0, 130.0], 2.0)[-1].decline_reason == DeclineReason.SEVERAL_ROTATIONS
    assert axis_only(ball, [0.0])[-1].decline_reason == DeclineReason.ROUND


def test_without_a_background_a_daemon_gets_no_rotation() -> None:
    assert DrawnFinger(plate, background=None).rest().decline_reason == DeclineReason.NO_BACKGROUND


@pytest.mark.parametrize("name", ["wrench", "bar", "knife_edge"])
def test_without_a_background_rendered_grasps_are_within_sigma(name: str) -> None:
    finger = RenderedFinger(name, 3, with_background=False)
    finger.rest()
    errors, answered = [], 0
    for k in range(1, 25):
        last = finger.see(1.0 * k)
        if last.rotation_deg is not None and last.sigma_deg is not None:
            answered += 1
            errors.append(abs(last.rotation_deg - k) / last.sigma_deg)
    assert answered >= 12
    assert max(errors) < 4.0
