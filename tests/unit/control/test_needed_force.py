"""The force that a load needs: from free slip, from the search while it arrives, and from the gel's torsion."""

from __future__ import annotations

import math

import pytest

from slipguard.control import needed_force as need
from slipguard.control.needed_force import FRICTION_PRIOR, STIFFNESS_PRIOR, ElasticMotion, LogNormal
from slipguard.limit_surface import GRAVITY_M_S2, Pad, force_needed_n, torque_limit_n_m


def test_the_force_for_a_larger_torque_is_that_of_the_limit_surface() -> None:
    for ratio in (1.1, 1.5, 2.5):
        needed = need.needed_force(40.0, ratio, slides=False, friction=FRICTION_PRIOR, modelled_n=None)
        held_n_m = 2.0 * torque_limit_n_m(needed.force_n, FRICTION_PRIOR.median, Pad())
        assert held_n_m == pytest.approx(needed.load)
        assert held_n_m == pytest.approx(ratio * need.torque_n_m(40.0, FRICTION_PRIOR.median))


def test_the_force_for_a_larger_load_without_lever_is_proportional_to_it() -> None:
    needed = need.needed_force(30.0, 1.5, slides=True, friction=LogNormal(0.4, 0.2), modelled_n=None)
    assert needed.force_n == pytest.approx(45.0)
    assert needed.load == pytest.approx(2 * 0.4 * 45.0)
    assert needed.force_n == pytest.approx(force_needed_n(0.5 * needed.load, 0.0, 0.4, Pad()))
    assert needed.reason == "load 36.0 N, friction 0.40 ± 0.08"


def test_a_given_object_counts_if_it_needs_more() -> None:
    for modelled_n, force_n in ((90.0, 90.0), (10.0, 45.0)):
        needed = need.needed_force(30.0, 1.5, slides=True, friction=FRICTION_PRIOR, modelled_n=modelled_n)
        assert needed.force_n == pytest.approx(force_n)


@pytest.mark.parametrize("ratio", [1.5, 2.0])
def test_the_excess_of_the_load_follows_from_the_free_rotation(ratio: float) -> None:
    lever_mm, after_s = 80.0, 0.05
    alpha_rad_s2 = 0.75 * GRAVITY_M_S2 / (1e-3 * lever_mm) * (1.0 - 1.0 / ratio)
    rotation_deg = math.degrees(0.5 * alpha_rad_s2 * after_s**2)
    rate_deg_s = math.degrees(alpha_rad_s2 * after_s)
    assert need.load_ratio(rotation_deg, rate_deg_s, 0.0, 0.0, lever_mm, 1.0) == pytest.approx(ratio)


def test_the_excess_of_the_load_follows_from_the_free_slide() -> None:
    a_m_s2, after_s = GRAVITY_M_S2 * (1.0 - 1.0 / 1.8), 0.03
    slip_mm, rate_mm_s = 500.0 * a_m_s2 * after_s**2, 1000.0 * a_m_s2 * after_s
    assert need.load_ratio(0.0, 0.0, slip_mm, rate_mm_s, 0.0, 1.0) == pytest.approx(1.8)


@pytest.mark.parametrize(
    ("motion", "ratio"),
    [
        ((0.0, 0.0, 0.0, 0.0), need.QUICK.ratio_least),
        ((5.0, -900.0, 5.0, -900.0), need.QUICK.ratio_least),
        ((5.0, 9000.0, 0.0, 0.0), need.RATIO_MAX),
        ((0.0, 0.0, 0.5, 9000.0), need.RATIO_MAX),
    ],
)
def test_the_ratio_is_limited(motion: tuple[float, float, float, float], ratio: float) -> None:
    assert need.load_ratio(*motion, 0.0, need.QUICK.ratio_least) == pytest.approx(ratio)


def test_a_gel_bears_what_the_limit_surface_and_its_stiffness_say() -> None:
    """Torsion and shear of a half-space: tau = 16/3 G a^3 theta, f = 16/3 G a s (Johnson 3.10, 3.7 at nu = 0.5)."""
    gel, radius_m = LogNormal(0.2, 0.0), Pad().contact_radius_m(40.0)
    shear_modulus_pa = 0.2 / (16.0 / 3.0 * need.STIFFNESS_RADIUS_M**3)
    torque_n_m = torque_limit_n_m(40.0, 0.6, Pad())
    elastic_limit = need.elastic_limit(40.0, LogNormal(0.6, 0.0), gel)
    assert elastic_limit.deg == pytest.approx(math.degrees(torque_n_m / (16.0 / 3.0 * shear_modulus_pa * radius_m**3)))
    assert elastic_limit.mm == pytest.approx(1e3 * 0.6 * 40.0 / (16.0 / 3.0 * shear_modulus_pa * radius_m))
    assert need.elastic_limit(0.0, FRICTION_PRIOR, gel) == need.ElasticMotion()
    assert need.elastic_limit(200.0, FRICTION_PRIOR, LogNormal(0.01, 0.0)) == need.ElasticMotion(
        need.ELASTIC_MAX_DEG, need.ELASTIC_MAX_MM
    )


def test_the_less_is_known_of_the_gel_the_less_motion_is_excused() -> None:
    spreads = (0.0, 0.3, 0.6, 0.79, 0.8)
    elastic_deg = [need.elastic_limit(40.0, FRICTION_PRIOR, LogNormal(0.2, spread)).deg for spread in spreads]
    assert elastic_deg == sorted(elastic_deg, reverse=True)
    assert elastic_deg[-2] < 0.55 * elastic_deg[0]
    unknown = need.elastic_limit(40.0, FRICTION_PRIOR, STIFFNESS_PRIOR)
    assert (unknown.deg, unknown.mm) == (need.UNKNOWN_MAX_DEG, need.UNKNOWN_MAX_MM)


@pytest.mark.parametrize("true_n_m_rad", [0.1, 0.3, 1.0, 50.0])
def test_the_stiffness_is_learned_from_objects_that_hang_at_rest(true_n_m_rad: float) -> None:
    gel = STIFFNESS_PRIOR
    for share in (0.2, 0.5, 0.4, 0.7, 0.3):
        torsion_deg = share * need.onset(40.0, 0.6, true_n_m_rad).deg
        gel = need.after_lift(
            (40.0, ElasticMotion(torsion_deg)), (40.0, ElasticMotion(torsion_deg)), FRICTION_PRIOR, gel
        )
    assert gel.spread < 0.5
    if true_n_m_rad < 10.0:
        assert gel.median == pytest.approx(true_n_m_rad, rel=0.4)
    else:
        assert gel.median > 2.0  # torsion below the noise: at least so stiff
    for _ in range(20):
        gel = need.after_lift((40.0, ElasticMotion(2.0)), (40.0, ElasticMotion(2.0)), FRICTION_PRIOR, gel)
    assert gel.spread == need.STIFFNESS_SPREAD_LEAST


def test_an_object_without_a_lever_shows_the_stiffness_by_its_shear() -> None:
    first = need.onset(40.0, FRICTION_PRIOR.median, 0.3)
    twisted = 40.0, ElasticMotion(deg=0.4 * first.deg)
    sheared = 40.0, ElasticMotion(mm=0.4 * first.mm)
    by_torsion = need.after_lift(twisted, twisted, FRICTION_PRIOR, STIFFNESS_PRIOR)
    by_shear = need.after_lift(sheared, sheared, FRICTION_PRIOR, STIFFNESS_PRIOR)
    assert by_shear.median == pytest.approx(by_torsion.median, rel=1e-6)
    assert by_shear.spread == pytest.approx(by_torsion.spread)


def test_a_rotation_that_may_have_been_slip_shows_little_about_the_gel() -> None:
    """4 degrees since the grip, but next to none since the last step."""
    known = LogNormal(2.0, 0.5)
    slipped = need.after_lift((20.0, ElasticMotion(4.0)), (30.0, ElasticMotion(0.05)), FRICTION_PRIOR, known)
    twisted = need.after_lift((20.0, ElasticMotion(4.0)), (30.0, ElasticMotion(4.0)), FRICTION_PRIOR, known)
    assert slipped.median > 0.75 * known.median
    assert slipped.spread > 0.9 * known.spread
    assert twisted.median < 0.6 * known.median


def test_the_first_slip_on_a_known_gel_shows_the_friction() -> None:
    gel = LogNormal(0.3, 0.1)
    friction = need.after_slip(40.0, need.onset(40.0, 0.3, 0.3).deg, FRICTION_PRIOR, gel)
    assert friction.median < 0.55
    assert friction.spread < FRICTION_PRIOR.spread
    unsure = need.after_slip(40.0, need.onset(40.0, 0.3, 0.3).deg, FRICTION_PRIOR, LogNormal(0.3, 1.5))
    assert unsure.median > friction.median


def test_a_given_friction_is_more_certain() -> None:
    assert need.friction_of(None) == FRICTION_PRIOR
    assert need.friction_of(0.4).median == 0.4
    assert need.friction_of(0.4).spread < FRICTION_PRIOR.spread


def test_gentle_steps_are_smaller_in_every_respect() -> None:
    quick, gentle = need.QUICK, need.GENTLE
    assert (gentle.search, gentle.ratio_least, gentle.margin) < (quick.search, quick.ratio_least, quick.margin)
    assert need.load_ratio(0.0, 0.0, 0.0, 0.0, 0.0, gentle.ratio_least) == gentle.ratio_least
