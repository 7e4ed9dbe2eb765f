"""The exact updates of friction and stiffness, compared with a Kalman filter in the logarithm, computed here."""

from __future__ import annotations

import math

import pytest

from slipguard.control import needed_force as need
from slipguard.control.needed_force import ElasticMotion, LogNormal

FRICTION, STIFFNESS, FORCE_N = LogNormal(0.5, 0.3), LogNormal(0.2, 0.6), 40.0


def test_the_first_slip_moves_the_friction_by_its_share_of_the_variance() -> None:
    onset_deg = need.onset(FORCE_N, 0.5, 0.2).deg
    found = need.after_slip(FORCE_N, 2.0 * onset_deg, FRICTION, STIFFNESS)
    gain = 0.09 / (0.09 + 0.36 + 0.25)
    assert found.median == pytest.approx(0.5 * 2.0**gain)
    assert found.spread == pytest.approx(0.3 * math.sqrt(1.0 - gain))


def test_a_lift_moves_the_stiffness_by_its_share_and_less_if_the_two_torsions_differ() -> None:
    held_deg = need.HELD_SHARE * need.onset(FORCE_N, 0.5, 0.2).deg
    found = need.after_lift(
        (FORCE_N, ElasticMotion(4.0 * held_deg)), (FORCE_N, ElasticMotion(2.0 * held_deg)), FRICTION, STIFFNESS
    )
    apart = 0.5 * math.log(2.0)
    gain = 0.36 / (0.09 + 0.36 + 0.49 + apart**2)
    assert found.median == pytest.approx(0.2 * 8.0 ** (-0.5 * gain))
    assert found.spread == pytest.approx(0.6 * math.sqrt(1.0 - gain))


def test_the_likeliest_torsion_is_below_the_median_by_both_variances() -> None:
    onset = need.onset(FORCE_N, 0.5, 0.2)
    found = need.elastic_limit(FORCE_N, FRICTION, STIFFNESS)
    assert found.deg == pytest.approx(math.exp(-0.09 - 0.36) * onset.deg)
    assert found.deg < need.ELASTIC_MAX_DEG


@pytest.mark.parametrize(("rotation_deg", "rate_deg_s"), [(0.5, 30.0), (0.5, 0.5)])
def test_a_small_rotation_is_judged_by_its_acceleration(rotation_deg: float, rate_deg_s: float) -> None:
    share = math.radians(rate_deg_s**2 / (2.0 * rotation_deg)) / (0.75 * 9.80665 / 0.01)
    found = need.load_ratio(rotation_deg, rate_deg_s, 0.0, 0.0, 10.0, 1.0)
    assert found == pytest.approx(1.0 / (1.0 - share), rel=1e-9)


@pytest.mark.parametrize("force_n", [0.0, 1e-300, 1e-9])
def test_a_grip_with_almost_no_force_teaches_no_infinity(force_n: float) -> None:
    soft = need.after_lift((force_n, ElasticMotion(0.0)), (force_n, ElasticMotion(10.0)), FRICTION, STIFFNESS)
    slippery = need.after_slip(force_n, 10.0, FRICTION, STIFFNESS)
    assert all(0.01 < one.median < 10.0 and 0.0 < one.spread < 1.0 for one in (soft, slippery))
