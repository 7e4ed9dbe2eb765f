"""After lost frames the rotation is found again, or declined where the texture fits at several rotations."""

from __future__ import annotations

import math

import numpy as np
import pytest
from held_finger import FRAME_S, DrawnFinger, RenderedFinger
from textured_surfaces import Heights, Surface, gear, lettered, nut, plate, ring, toothed

from slipguard.perception.estimate import DeclineReason, Estimate

AMBIGUOUS = DeclineReason.SEVERAL_ROTATIONS


def square(u: Heights, v: Heights) -> Heights:
    away = np.maximum(np.maximum(np.abs(u), np.abs(v)) - 26.0, 0.0)
    return np.asarray(9.0 * np.exp(-away * away / 100.0), np.float32)


def held(surface: Surface) -> DrawnFinger:
    finger = DrawnFinger(surface, reference="first", skip_unchanged=False)
    assert finger.rest(3).rotation_deg == pytest.approx(0.0, abs=0.5)
    return finger


def assert_right(estimate: Estimate, true_deg: float) -> None:
    assert estimate.rotation_deg == pytest.approx(true_deg, abs=0.5), estimate.declined
    assert estimate.sigma_deg is not None
    assert estimate.sigma_deg < 2.0


@pytest.mark.parametrize(
    ("surface", "gap_s", "rotation_deg"),
    [(gear, 0.1, 22.0), (nut, 0.145, 50.0), (nut, 2.0, 44.0), (square, 2.0, 75.0), (plate, 2.0, 120.0)],
)
def test_after_a_gap_long_enough_for_a_period_the_rotation_stays_ambiguous(
    surface: Surface, gap_s: float, rotation_deg: float
) -> None:
    finger = held(surface)
    seen = [finger.see(rotation_deg, gap_s), *(finger.see(rotation_deg) for _ in range(4))]
    assert {one.decline_reason for one in seen} == {AMBIGUOUS}
    assert {one.rotation_deg for one in seen} == {None}
    assert all(one.contact and one.shift_mm is not None for one in seen)


@pytest.mark.parametrize("surface", [gear, nut, plate, lettered])
def test_one_lost_frame_is_bridged(surface: Surface) -> None:
    finger = held(surface)
    for k in range(1, 4):
        assert_right(finger.see(4.0 * k, 2.0 * FRAME_S), 4.0 * k)


@pytest.mark.parametrize(("surface", "rotation_deg"), [(lettered, 8.0), (lettered, -130.0)])
@pytest.mark.parametrize("gap_s", [0.3, 5.0])
def test_a_texture_that_fits_once_is_found_after_any_gap(surface: Surface, gap_s: float, rotation_deg: float) -> None:
    finger = held(surface)
    for after_s in (gap_s, FRAME_S, FRAME_S):
        assert_right(finger.see(rotation_deg, after_s), rotation_deg)


@pytest.mark.parametrize("acceleration_deg_s2", [300.0, 7_500.0])
@pytest.mark.parametrize("teeth", [12, 24])
def test_no_tooth_is_miscounted_while_a_rotation_accelerates(acceleration_deg_s2: float, teeth: int) -> None:
    measured = 0
    for begin in (0.2, 0.7):  # part of the frame in which the rotation begins
        finger = held(toothed(teeth))
        for k in range(1, 10):
            true_deg = 0.5 * acceleration_deg_s2 * ((k - begin) * FRAME_S) ** 2
            seen = finger.see(true_deg)
            if seen.rotation_deg is not None and seen.sigma_deg is not None:
                measured += 1
                assert abs(seen.rotation_deg - true_deg) < 4.0 * seen.sigma_deg + 0.05
    assert measured >= (18 if acceleration_deg_s2 < 1_000.0 else 10)


@pytest.mark.parametrize("stops", [True, False])
def test_a_fast_gear_that_may_have_stopped_in_a_gap_is_never_a_tooth_off(stops: bool) -> None:
    finger = held(gear)
    for k in range(1, 7):
        assert_right(finger.see(6.0 * k), 6.0 * k)
    true_deg = 36.0 if stops else 36.0 + 360.0 * 0.09
    for after_s in (0.09, FRAME_S, FRAME_S):
        seen = finger.see(true_deg, after_s)
        assert seen.rotation_deg is None or abs(seen.rotation_deg - true_deg) < 4.0 * (seen.sigma_deg or 0.0)


def test_a_frame_skipped_because_the_other_finger_is_at_rest_bridges_a_gap() -> None:
    measured = {}
    for kept in (True, False):
        finger = held(gear)
        for k in range(1, 13):
            if kept:
                finger.pipeline.keep_estimate(finger.now_s + k * FRAME_S)
        measured[kept] = finger.see(0.5, 13.0 * FRAME_S)
    assert_right(measured[True], 0.5)
    assert measured[False].declined is not None


def test_a_rest_seen_only_afterwards_does_not_resolve_an_ambiguity() -> None:
    finger = held(gear)
    assert finger.see(0.0, 1.0).decline_reason == AMBIGUOUS
    finger.pipeline.keep_estimate(finger.now_s + FRAME_S)
    assert finger.see(0.0, 2.0 * FRAME_S).decline_reason == AMBIGUOUS


def test_frames_that_are_irregular_count_the_same_teeth() -> None:
    finger, rng = held(gear), np.random.default_rng(4)
    rotation_deg = 0.0
    for after_s in rng.choice([0.008, 0.0166, 0.0334], 24):
        rotation_deg += 200.0 * float(after_s)
        seen = finger.see(rotation_deg, float(after_s))
        assert seen.rotation_deg is not None
        assert seen.sigma_deg is not None
        assert abs(seen.rotation_deg - rotation_deg) < 4.0 * seen.sigma_deg + 0.05


@pytest.mark.parametrize(("name", "seed"), [("key", 3), ("wrench", 3), ("hook", 1)])
@pytest.mark.parametrize("rotation_deg", [30.0, -110.0])
def test_a_rendered_object_is_found_after_lost_frames(name: str, seed: int, rotation_deg: float) -> None:
    finger = RenderedFinger(name, seed)
    finger.rest()
    for after_s in (0.2, *([FRAME_S] * 7)):
        seen = finger.see(rotation_deg, after_s)
        assert seen.rotation_deg is not None, seen.declined
        assert seen.sigma_deg is not None
        assert abs(seen.rotation_deg - rotation_deg) < 4.0 * seen.sigma_deg
    assert seen.rotation_deg == pytest.approx(rotation_deg, abs=1.0)


@pytest.mark.parametrize(("name", "period_deg"), [("nut", 60.0), ("bar", 180.0)])
def test_a_rendered_periodic_object_is_never_a_period_off(name: str, period_deg: float) -> None:
    for seed, gap_s, true_deg in ((1, 0.1, 40.0), (2, 0.3, 100.0), (3, 1.0, 150.0), (4, 0.05, 20.0)):
        finger = RenderedFinger(name, seed)
        finger.rest()
        for after_s in (gap_s, FRAME_S, FRAME_S, FRAME_S):
            seen = finger.see(true_deg, after_s)
            if seen.rotation_deg is not None and seen.sigma_deg is not None:
                off_deg = abs(seen.rotation_deg - true_deg)
                assert off_deg < min(4.0 * seen.sigma_deg + 0.1, 0.5 * period_deg), (seed, gap_s)


@pytest.mark.parametrize("name", ["wrench", "key", "bar"])
def test_a_jerk_faster_than_any_assumed_motion_is_measured_within_a_tenth_of_a_second(name: str) -> None:
    finger = RenderedFinger(name, 3)
    finger.rest(12)
    for _ in range(7):
        seen = finger.see(25.0)
        assert seen.rotation_deg is None or abs(seen.rotation_deg - 25.0) < 4.0 * (seen.sigma_deg or 0.0)
    assert_right(seen, 25.0)


def test_another_object_after_a_gap_gives_no_rotation() -> None:
    finger = held(lettered)
    finger.surface = ring
    assert finger.see(0.0, 1.0).rotation_deg is None
    assert {finger.see(0.0).rotation_deg for _ in range(8)} == {None}
    finger.surface = lettered
    for _ in range(5):
        last = finger.see(20.0)
    assert_right(last, 20.0)


def test_a_wandering_clock_is_no_gap() -> None:
    finger = held(gear)
    for k, after_s in enumerate((FRAME_S, -0.5, FRAME_S, FRAME_S), 1):
        seen = finger.see(0.5 * k, after_s)
        assert seen.rotation_deg is None or math.isclose(seen.rotation_deg, 0.5 * k, abs_tol=0.5)
