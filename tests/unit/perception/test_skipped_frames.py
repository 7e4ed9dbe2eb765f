"""Which frames run the network or nothing at all; skipping gives the answers that measuring gives."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise

import numpy as np
import pytest
from held_finger import FRAME_S, DrawnFinger, RenderedFinger
from textured_surfaces import lettered, plate, ring

from slipguard.perception.skipping import ALL_SKIPS, Skips

NO_SKIPS = Skips(no_contact=False, unchanged=False, whole=False)


def still(at_s: float) -> float:
    return 0.0


def creeping(at_s: float) -> float:
    return 3.0 * at_s


def slipping(at_s: float) -> float:
    return 60.0 * max(at_s - 0.3, 0.0)


def jerking(at_s: float) -> float:
    return 8.0 * (at_s > 0.4)


@pytest.mark.parametrize("motion", [still, creeping, slipping, jerking])
@pytest.mark.parametrize("name", ["wrench", "bar"])
def test_skipping_gives_the_same_answers(name: str, motion: Callable[[float], float]) -> None:
    fingers = [RenderedFinger(name, 3, skips=skips) for skips in (ALL_SKIPS, NO_SKIPS)]
    for finger in fingers:
        finger.rest(12)
    for k in range(60):
        skipping, measuring = (finger.see(motion(k * FRAME_S)) for finger in fingers)
        assert skipping.rotation_deg is not None
        assert measuring.rotation_deg is not None
        assert measuring.skipped is None
        assert measuring.segmented
        sigma_deg = max(skipping.sigma_deg or 0.0, measuring.sigma_deg or 0.0)
        assert abs(skipping.rotation_deg - measuring.rotation_deg) < 2.0 * sigma_deg + 0.1
        assert skipping.captured_at_s == measuring.captured_at_s
        assert (skipping.sequence, skipping.contact) == (measuring.sequence, measuring.contact)
    assert fingers[0].network.calls < 0.5 * fingers[1].network.calls


def test_at_rest_the_network_runs_four_times_a_second_and_a_glitch_changes_nothing() -> None:
    finger = RenderedFinger("wrench", 3)
    finger.rest(12)
    calls, skipped = finger.network.calls, 0
    for k in range(130):
        last = finger.see(3.0 if k == 100 else 0.0)
        skipped += last.skipped == "unchanged"
        assert last.rotation_deg == pytest.approx(3.0 if k == 100 else 0.0, abs=0.3)
        assert 0.0 <= last.captured_at_s - last.measured_at_s < 0.25
    assert finger.network.calls - calls <= 15
    assert skipped > 60


def test_an_unchanged_image_is_measured_every_quarter_second_and_a_change_at_once() -> None:
    finger = DrawnFinger(plate)
    finger.rest()
    seen = [finger.see(0.0) for _ in range(90)]
    measured = [one for one in seen if one.skipped is None]
    assert {one.skipped for one in seen} == {None, "unchanged"}
    assert all(0.0 <= one.captured_at_s - one.measured_at_s < 0.25 for one in seen)
    assert len(measured) < 50  # half a second to be sure of the rest, then four a second
    moved = finger.see(1.5)
    assert moved.skipped is None
    assert moved.rotation_deg == pytest.approx(1.5, abs=0.3)


def test_a_creeping_rotation_is_followed_despite_skips() -> None:
    finger = DrawnFinger(plate)
    finger.rest()
    for k in range(80):
        last = finger.see(0.05 * k)
        assert last.rotation_deg == pytest.approx(0.05 * k, abs=0.5)


def test_skipping_of_unchanged_images_can_be_switched_off() -> None:
    finger = DrawnFinger(plate, skip_unchanged=False)
    finger.rest()
    assert {finger.see(0.0).skipped for _ in range(40)} == {None}


@pytest.mark.parametrize("change", ["second contact", "growth", "leap", "none left"])
def test_a_contact_that_changes_is_segmented_in_the_same_frame(change: str) -> None:
    finger = DrawnFinger(lettered)
    finger.rest(8)
    calls = finger.network.calls
    if change == "second contact":
        finger.surface = lambda u, v: lettered(u, v) + 12.0 * np.exp(-((u - 90.0) ** 2 + (v + 90.0) ** 2) / 300.0)
    elif change == "growth":
        finger.surface = lambda u, v: 1.4 * lettered(u / 1.4, v / 1.4)
    elif change == "none left":
        finger.surface = None
    seen = finger.see(20.0 if change == "leap" else 0.0)
    assert finger.network.calls == calls + (change != "none left")
    assert seen.contact is (change != "none left")
    assert seen.segmented


def test_a_smooth_shaft_runs_the_network_on_every_second_frame() -> None:
    """Only its ends show a slide, and only the network shows the ends."""
    finger = RenderedFinger("screwdriver", 3, angle_deg=30.0)
    finger.rest(12)
    segmented = []
    for k in range(20):
        last = finger.see(0.6 * k)
        segmented.append(last.segmented or last.skipped is not None)
        assert last.rotation_deg is not None
        assert abs(last.rotation_deg - 0.6 * k) < 4.0 * (last.sigma_deg or 0.0)
    assert all(before or now for before, now in pairwise(segmented))
    assert sum(segmented) < 16


def test_a_round_contact_runs_few_networks_and_its_shift_is_still_measured() -> None:
    finger = DrawnFinger(ring)
    finger.rest()
    calls = finger.network.calls
    for k in range(24):
        last = finger.see(0.0, at=(120.0, 160.0 - 1.2 * k))
        assert last.decline_reason == "round contact"
        assert last.shift_mm == pytest.approx((0.0, 1.2 * k / 18.5), abs=0.1)
    assert finger.network.calls - calls <= 14
