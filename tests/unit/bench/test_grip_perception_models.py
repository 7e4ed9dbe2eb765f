"""The error model of the grip bench: reference, biases, correlation, drop-outs."""

from __future__ import annotations

import dataclasses
from itertools import pairwise

import numpy as np
import pytest

from slipguard.bench.grip.perception_models import (
    PERCEPTION_ERRORS,
    ModeledFinger,
    PerceptionErrors,
    RotationDrift,
    RotationOutliers,
    errors_from_csv,
)
from slipguard.bench.grip.scenarios import TEST_OBJECTS
from slipguard.perception.estimate import Estimate
from slipguard.sim.gel_view import GelView

EXACT = PerceptionErrors(0.0, 0.0, 0.0, 0.2, shift_noise_mm=0.0)


def at_rest(finger: ModeledFinger, frames: int = 6) -> list[Estimate]:
    return [finger.process(GelView("key", angle_deg=20.0, depth_mm=0.5), 0.02 * k, k) for k in range(frames)]


def after(finger: ModeledFinger, view: GelView) -> Estimate:
    at_rest(finger)
    return finger.process(view, 0.14, 7)


def test_it_takes_a_reference_and_reports_rotation_and_shift_since_then() -> None:
    finger = ModeledFinger(EXACT, np.random.default_rng(1))
    assert [one.rotation_deg is None for one in at_rest(finger)] == [True] * 4 + [False] * 2
    moved = finger.process(GelView("key", 1.0, -2.0, 21.0, 0.5), 0.14, 7)
    assert (moved.rotation_deg, moved.shift_mm, moved.sigma_deg) == (pytest.approx(1.0), (1.0, -2.0), 0.2)
    assert not finger.process(GelView("key"), 0.16, 8).contact


def test_errors_are_read_by_the_name_of_their_column() -> None:
    found = errors_from_csv("object,growth_deg,noise_deg\nkey,0.5,0.01\n")
    assert found == {"key": PerceptionErrors(growth_deg=0.5, noise_deg=0.01)}


def test_every_test_object_has_measured_errors_of_rotation_and_shift() -> None:
    assert set(PERCEPTION_ERRORS) == set(TEST_OBJECTS)
    assert max(one.shift_growth_mm for one in PERCEPTION_ERRORS.values()) > 0.5
    assert all(one.noise_deg > 0.0 and one.shift_noise_mm > 0.0 for one in PERCEPTION_ERRORS.values())


@pytest.mark.parametrize(
    ("errors", "view"),
    [
        ({"bias_per_deg": 0.1}, GelView("key", 0.0, 0.0, 40.0, 0.5)),
        ({"growth_deg": 5.0}, GelView("key", 0.0, 0.0, 20.0, 0.7)),
        ({"shift_per_deg_mm": 0.1}, GelView("key", 0.0, 0.0, 40.0, 0.5)),
        ({"shift_growth_mm": 1.0}, GelView("key", 0.0, 0.0, 20.0, 0.7)),
        ({"shift_per_mm": 0.3}, GelView("key", 0.0, 5.0, 20.0, 0.5)),
    ],
)
def test_each_bias_is_an_error_that_differs_between_grasps(errors: dict[str, float], view: GelView) -> None:
    model = PerceptionErrors(0.0, 0.0, 0.0, 0.2, shift_noise_mm=0.0)
    biased = dataclasses.replace(model, **errors)
    exact = after(ModeledFinger(model, np.random.default_rng(1)), view)
    one, other = (after(ModeledFinger(biased, np.random.default_rng(seed)), view) for seed in (1, 2))
    assert (one.rotation_deg, one.shift_mm) != (exact.rotation_deg, exact.shift_mm)
    assert (one.rotation_deg, one.shift_mm) != (other.rotation_deg, other.shift_mm)


def test_the_wander_is_correlated_over_time() -> None:
    finger = ModeledFinger(PerceptionErrors(0.0, 0.0, 0.0, 0.2, wander_deg=0.5), np.random.default_rng(3))
    errors = [one.rotation_deg for one in at_rest(finger, 400) if one.rotation_deg is not None]
    steps = np.abs(np.diff(errors))
    assert np.std(errors) > 3.0 * np.median(steps)


def test_drop_outs_last_and_a_share_of_one_declines_all() -> None:
    finger = ModeledFinger(PerceptionErrors(declined=0.3, declined_s=0.2), np.random.default_rng(3))
    lost = [one.declined is not None for one in at_rest(finger, 600)[5:]]
    runs = sum(a and not b for a, b in pairwise(lost))
    assert 0.1 < np.mean(lost) < 0.5
    assert sum(lost) > 4 * runs
    always = ModeledFinger(PerceptionErrors(declined=1.0), np.random.default_rng(1))
    assert at_rest(always)[-1].declined is not None


def test_drift_and_single_wrong_frames_are_added() -> None:
    finger = ModeledFinger(EXACT, np.random.default_rng(1), RotationDrift(0.5, 0.56, 0.0))
    finger.add_outliers(RotationOutliers((0.13,), 3.0))
    assert after(finger, GelView("key", angle_deg=20.0, depth_mm=0.5)).rotation_deg == pytest.approx(3.0, abs=0.6)
