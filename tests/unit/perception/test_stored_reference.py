"""After a restart a pipeline continues with its stored reference, or finds that it does not match."""

from __future__ import annotations

import numpy as np
import pytest
from held_finger import DrawnFinger, RenderedFinger
from textured_surfaces import Surface, ball, gear, lettered, nut, plate

from slipguard.errors import FrameCorrupt
from slipguard.perception.estimate import DeclineReason
from slipguard.perception.stored_reference import DIFFERS_AFTER, MATCHES_AFTER, ResumingPipeline, StoredReference

RESTART_S = 10.0
WAITING = "no reference yet: checking the stored one"


def before(rotation_deg: float, surface: Surface = lettered) -> StoredReference:
    """Return what a pipeline that is gone now has left behind."""
    finger = DrawnFinger(surface)
    finger.rest()
    for part in np.linspace(0.0, rotation_deg, 12):
        last = finger.see(float(part))
    image = finger.resuming.reference_image
    assert image is not None
    assert last.rotation_deg is not None
    return StoredReference(image, last.rotation_deg)


def resumed(
    stored: StoredReference, surface: Surface | None = lettered, shown: Surface | None = lettered
) -> DrawnFinger:
    """Return a finger of a new process that resumes, before a surface. shown: what the stored image shows."""
    finger = DrawnFinger(shown)
    finger.draw(0.0)
    finger.now_s = RESTART_S
    finger.resuming.resume(stored, RESTART_S)
    finger.surface = surface
    return finger


@pytest.mark.parametrize(("rotation_deg", "now_deg"), [(0.0, 0.0), (14.0, 17.0), (-38.0, -35.0), (70.0, 20.0)])
def test_the_rotation_continues_wherever_the_object_is_now(rotation_deg: float, now_deg: float) -> None:
    stored = before(rotation_deg)
    finger = resumed(stored)
    assert finger.resuming.stored_reference_state == "waiting"
    assert finger.resuming.reference_image is None
    seen = [finger.see(now_deg) for _ in range(MATCHES_AFTER)]
    assert [one.declined for one in seen[:-1]] == [WAITING] * (MATCHES_AFTER - 1)
    assert all(one.rotation_deg is None and one.shift_mm is None for one in seen[:-1])
    assert seen[-1].rotation_deg == pytest.approx(now_deg, abs=0.5)
    assert finger.resuming.stored_reference_state == "matches"
    assert finger.resuming.reference_image is stored.image
    assert finger.see(now_deg + 8.0).rotation_deg == pytest.approx(now_deg + 8.0, abs=0.5)


@pytest.mark.parametrize("name", ["wrench", "key", "hook"])
def test_a_rendered_object_is_recognized(name: str) -> None:
    finger = RenderedFinger(name, 3)
    finger.rest()
    for rotation_deg in (5.0, 10.0, 14.0):
        last = finger.see(rotation_deg)
    image = finger.pipeline.reference_image
    assert image is not None
    assert last.rotation_deg is not None
    resuming = ResumingPipeline(finger.pipeline)
    resuming.resume(StoredReference(image, last.rotation_deg), RESTART_S)
    finger.now_s = RESTART_S
    seen = [resuming.process(finger.draw(17.0)) for _ in range(MATCHES_AFTER)]
    assert resuming.stored_reference_state == "matches"
    assert seen[-1].rotation_deg == pytest.approx(17.0, abs=0.5)


@pytest.mark.parametrize("other", [ball, plate, gear])
def test_another_object_gets_a_new_reference_and_continues_from_the_last_rotation(other: Surface) -> None:
    finger = resumed(before(14.0), other)
    seen = [finger.see(0.0) for _ in range(DIFFERS_AFTER)]
    assert {one.rotation_deg for one in seen} == {None}
    assert {one.declined for one in seen[:-1]} == {WAITING}
    assert finger.resuming.stored_reference_state == "differs"
    finger.surface = lettered
    finger.rest(6, 40.0)
    for rotation_deg in (42.0, 44.0, 47.0):
        last = finger.see(rotation_deg)
    assert last.rotation_deg == pytest.approx(14.0 + 7.0, abs=0.5)
    assert finger.resuming.earlier_rotation_deg == pytest.approx(14.0, abs=0.5)


@pytest.mark.parametrize("surface", [gear, nut])
def test_a_periodic_object_is_never_reported_a_period_off(surface: Surface) -> None:
    finger = resumed(before(14.0, surface), surface, surface)
    waiting = [finger.see(50.0) for _ in range(DIFFERS_AFTER)]
    assert {one.rotation_deg for one in waiting} == {None}
    assert finger.resuming.stored_reference_state == "differs"


def test_the_rotation_before_the_stored_reference_is_added() -> None:
    stored = before(14.0)
    stored = StoredReference(stored.image, stored.rotation_deg, 5.0)
    finger = resumed(stored)
    assert finger.rest(4, 16.0).rotation_deg == pytest.approx(5.0 + 16.0, abs=0.5)
    assert finger.resuming.earlier_rotation_deg == 5.0
    finger = resumed(stored, ball)
    finger.rest(DIFFERS_AFTER)
    assert finger.resuming.earlier_rotation_deg == pytest.approx(5.0 + 14.0, abs=0.5)


def test_a_reset_reference_starts_at_zero() -> None:
    finger = resumed(before(14.0))
    finger.resuming.reset_reference()
    assert finger.resuming.stored_reference_state is None
    assert finger.rest(6, 30.0).rotation_deg == pytest.approx(0.0, abs=0.2)


def test_without_contact_nothing_is_decided() -> None:
    finger = resumed(before(14.0), None)
    assert {finger.see(0.0).declined for _ in range(2 * DIFFERS_AFTER)} == {DeclineReason.NO_CONTACT}
    assert finger.resuming.stored_reference_state == "waiting"


def test_a_stored_image_without_contact_does_not_match() -> None:
    finger = resumed(StoredReference(DrawnFinger(None).draw(0.0).image, 14.0), None, None)
    assert finger.resuming.stored_reference_state == "differs"
    finger.surface = lettered
    assert finger.rest(6, 30.0).rotation_deg == pytest.approx(14.0, abs=0.2)


def test_a_stored_image_that_is_no_gel_image_is_an_error() -> None:
    with pytest.raises(FrameCorrupt):
        resumed(StoredReference(np.zeros((10, 10, 3), np.uint8), 0.0))
