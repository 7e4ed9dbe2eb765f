"""The error model of the grip bench: reference, biases, single wrong frames."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from slipguard.bench.grip.perception_models import ModeledFinger, PerceptionErrors
from slipguard.perception.estimate import Estimate
from slipguard.sim.gel_view import GelView

EXACT = PerceptionErrors(0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0)


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


@pytest.mark.parametrize(
    ("errors", "view"),
    [
        ({"bias_per_deg": 0.1}, GelView("key", 0.0, 0.0, 40.0, 0.5)),
        ({"growth_deg": 5.0}, GelView("key", 0.0, 0.0, 20.0, 0.7)),
        ({"shift_growth_mm": 1.0}, GelView("key", 0.0, 0.0, 20.0, 0.7)),
        ({"shift_per_mm": 0.3}, GelView("key", 0.0, 5.0, 20.0, 0.5)),
    ],
)
def test_each_bias_is_an_error_that_differs_between_grasps(errors: dict[str, float], view: GelView) -> None:
    model = PerceptionErrors(0.0, 0.0, 0.2, 0.0, 0.0, 0.0, 0.0)
    biased = dataclasses.replace(model, **errors)
    exact = after(ModeledFinger(model, np.random.default_rng(1)), view)
    one, other = (after(ModeledFinger(biased, np.random.default_rng(seed)), view) for seed in (1, 2))
    assert (one.rotation_deg, one.shift_mm) != (exact.rotation_deg, exact.shift_mm)
    assert (one.rotation_deg, one.shift_mm) != (other.rotation_deg, other.shift_mm)


def test_without_estimates_each_one_is_declined() -> None:
    always = ModeledFinger(PerceptionErrors(declined=True), np.random.default_rng(1))
    assert at_rest(always)[-1].declined is not None


def test_a_single_frame_is_wrong() -> None:
    finger = ModeledFinger(EXACT, np.random.default_rng(1))
    finger.add_outliers((0.13,), 3.0)
    assert after(finger, GelView("key", angle_deg=20.0, depth_mm=0.5)).rotation_deg == pytest.approx(3.0, abs=0.6)
    later = finger.process(GelView("key", angle_deg=20.0, depth_mm=0.5), 0.3, 8)
    assert later.rotation_deg == pytest.approx(0.0, abs=0.6)
