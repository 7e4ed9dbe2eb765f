"""Registration of contours measures rotation without an axis, through growth, shift and the frame's edge."""

from __future__ import annotations

import numpy as np
import pytest
from drawn_masks import drawn
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from slipguard.perception.contact.patch import Patch, find_patch
from slipguard.perception.rotation.contour_registration import ContourFit, ContourPose, ContourRegistrar
from slipguard.perception.rotation.contour_template import make_contour_template


def patch_of(probability: NDArray[np.float32]) -> Patch:
    patch = find_patch(probability, 0.5, 100, 2.0)
    assert patch is not None
    return patch


def followed(
    shape: str,
    rotations: list[float],
    center: tuple[float, float] = (60, 80),
    growth: float = 0.0,
    ragged_px: float = 0.3,
) -> list[ContourFit]:
    """Register a turning shape frame by frame, each from the last pose."""
    template = make_contour_template(patch_of(drawn(shape, 17.0, center, ragged_px=ragged_px)))
    pose, estimates = ContourPose(), []
    for k, rotation in enumerate(rotations, start=1):
        there = (center[0] + 0.2 * k, center[1] - 0.1 * k)
        image = drawn(shape, 17.0 + rotation, there, 1.0 + growth * k / len(rotations), ragged_px, seed=k)
        estimates.append(ContourRegistrar(template, patch_of(image)).fit(pose))
        pose = estimates[-1].pose
    return estimates


ROTATIONS = [3.0 * k for k in range(1, 21)]


@pytest.mark.parametrize("shape", ["bar", "rectangle", "square", "key", "wedge", "cross", "ellipse"])
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_rotations_are_tracked_through_growth_and_shift(shape: str, sign: float) -> None:
    rotations = [sign * rotation for rotation in ROTATIONS]
    for rotation, estimate in zip(rotations, followed(shape, rotations, growth=0.12), strict=True):
        assert estimate.declined is None
        assert abs(estimate.pose.rotation_deg - rotation) < min(1.6, 4.0 * estimate.sigma_deg)


def test_shift_is_that_of_the_patch() -> None:
    estimate = followed("key", ROTATIONS)[-1]
    m = followed("key", [0.5] * 20)[-1]
    assert (m.pose.dx_px, m.pose.dy_px) == pytest.approx((4.0, -2.0), abs=0.6)
    assert estimate.residual < 0.1


@pytest.mark.parametrize("center", [(60, 80), (80, 100), (40, 70)])
def test_a_bar_cut_twice_is_tracked_without_drift_along_its_axis(center: tuple[float, float]) -> None:
    rotations = [2.0 * k for k in range(1, 21)]
    for rotation, estimate in zip(rotations, followed("long bar", rotations, center), strict=True):
        assert abs(estimate.pose.rotation_deg - rotation) < 0.8
        assert np.hypot(estimate.pose.dx_px, estimate.pose.dy_px) < 20.0


@pytest.mark.parametrize("shape", ["disc", "ring"])
@pytest.mark.parametrize("center", [(60, 80), (105, 80), (108, 150)])
def test_round_contacts_decline(shape: str, center: tuple[float, float]) -> None:
    assert all(estimate.declined for estimate in followed(shape, ROTATIONS[:5], center))


def test_a_periodic_contour_declines() -> None:
    y, x = np.mgrid[0:160, 0:120]
    radius, azimuth = np.hypot(x - 60, y - 80), np.arctan2(y - 80, x - 60)
    gear = (1 / (1 + np.exp(np.clip((radius - 36 - 5 * np.cos(14 * azimuth)) / 0.6, -30, 30)))).astype(np.float32)
    template = make_contour_template(patch_of(gear))
    assert template.periodic
    assert ContourRegistrar(template, patch_of(gear)).fit(ContourPose()).declined == "contour repeats itself"
    assert not make_contour_template(patch_of(drawn("square"))).periodic


def test_another_contact_does_not_match_the_reference() -> None:
    template = make_contour_template(patch_of(drawn("bar", 0)))
    estimate = ContourRegistrar(template, patch_of(drawn("disc"))).fit(ContourPose())
    assert estimate.declined or estimate.sigma_deg > 3.0


@given(
    hnp.arrays(np.float32, (40, 30), elements=st.floats(0, 1, width=32)),
    hnp.arrays(np.float32, (40, 30), elements=st.floats(0, 1, width=32)),
    st.floats(-90, 90),
)
def test_any_two_maps_give_finite_numbers(before: NDArray[np.float32], now: NDArray[np.float32], start: float) -> None:
    reference, patch = find_patch(before, 0.5, 20, 2.0), find_patch(now, 0.5, 20, 2.0)
    if reference is None or patch is None:
        return
    estimate = ContourRegistrar(make_contour_template(reference), patch).fit(ContourPose(start))
    assert np.isfinite([estimate.pose.rotation_deg, estimate.sigma_deg, estimate.residual]).all()
    assert estimate.sigma_deg > 0.0
