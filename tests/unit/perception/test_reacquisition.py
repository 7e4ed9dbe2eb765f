"""After lost frames, the rotation is found anywhere and must agree over several frames; both fingers confirm a jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from slipguard.control.finger_fusion import FusedEstimate, fuse
from slipguard.datasets.rendered_grasps import bench_object
from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.declined import DeclineReason
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation import texture_tracker
from slipguard.perception.rotation.fusion import RotationEstimate
from slipguard.perception.rotation.rotation_tracker import AGREEING_FRAMES, GAP_S, RotationTracker
from slipguard.perception.rotation.texture_registration import likely_rotations_deg
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit

FRAME_S = 1.0 / 60.0
LOST_FRAMES = 11


class Finger:
    """A rendered object in one finger; its reference is taken in the first frames."""

    def __init__(self, name: str, seed: int, sign: float = 1.0) -> None:
        thing, _ = bench_object(name)
        rng = np.random.default_rng(seed)
        unit = random_unit(rng)
        self._camera, self._sign, self.frames, self._now_s = GelCamera(unit, seed=seed), sign, 0, 0.0
        background = self._camera.no_contact()
        x_mm, y_mm, start_deg = rng.uniform(-1, 1), rng.uniform(-1, 1), rng.uniform(-180, 180)
        self._view = GelView(name, x_mm, y_mm, start_deg, 0.6 * thing.press_mm)
        self._pipeline = Pipeline(Segmenter(), PerceptionSettings(), background, unit.noise_bgr, unit.px_per_mm)
        for _ in range(8):
            self.see(0.0)

    def lose(self, frames: int = LOST_FRAMES) -> None:
        self._now_s += frames * FRAME_S

    def show(self, name: str) -> None:
        """Replace the object."""
        self._view = replace(self._view, object_name=name)

    def see(self, rotation_deg: float) -> Estimate:
        view = replace(self._view, angle_deg=self._view.angle_deg + self._sign * rotation_deg)
        self.frames, self._now_s = self.frames + 1, self._now_s + FRAME_S
        return self._pipeline.process(Frame(self._camera.draw(view), self._now_s, self.frames))


def after_lost_frames(name: str, rotation_deg: float) -> list[FusedEstimate]:
    """Both fingers lose frames while the object rotates, and see it at rest then."""
    left, right = Finger(name, 3), Finger(name, 4, sign=-1.0)
    left.lose()
    right.lose()
    seen = [fuse(left.see(rotation_deg), right.see(rotation_deg)) for _ in range(AGREEING_FRAMES + 2)]
    return [one for one in seen if one is not None]


@pytest.mark.parametrize(("name", "rotation_deg"), [("key", 90.0), ("key", -110.0), ("wrench", 90.0)])
def test_both_fingers_confirm_a_jump(name: str, rotation_deg: float) -> None:
    *first, before, last = after_lost_frames(name, rotation_deg)
    assert first[0].rotation_deg is None
    for one in (before, last):
        assert one.rotation_deg == pytest.approx(rotation_deg, abs=0.5)
        assert one.sigma_deg is not None
        assert one.sigma_deg < 1.0
        assert one.conflict is None


def test_a_jump_that_only_an_axis_shows_has_a_sigma_that_covers_the_opposite_rotation() -> None:
    """A plain bar looks the same after 180 degrees."""
    last = after_lost_frames("bar", 105.0)[-1]
    assert last.rotation_deg is not None
    assert last.sigma_deg is not None
    assert abs(last.rotation_deg) > 60.0
    assert abs(last.rotation_deg - 105.0) < 4.0 * last.sigma_deg


def test_one_finger_alone_confirms_no_jump() -> None:
    left, right = Finger("key", 3), Finger("key", 4, sign=-1.0)
    left.lose()
    right.lose()
    for _ in range(AGREEING_FRAMES + 2):
        seen = fuse(left.see(90.0), right.see(0.0))
        assert seen is not None
        assert seen.rotation_deg == pytest.approx(0.0, abs=1.0)
        alone = fuse(left.see(90.0), None)
        assert alone is not None
        assert alone.rotation_deg is None


@pytest.mark.parametrize("rotation_deg", [0.0, 40.0])
def test_a_texture_is_regained_where_it_is(rotation_deg: float) -> None:
    finger = Finger("key", 5)
    finger.lose(22)
    seen = [finger.see(rotation_deg) for _ in range(AGREEING_FRAMES)]
    assert seen[-1].rotation_deg == pytest.approx(rotation_deg, abs=0.5)
    if rotation_deg:
        assert [one.decline_reason for one in seen[:-1]] == [DeclineReason.REGAINED] * (AGREEING_FRAMES - 1)


def test_a_search_that_found_nothing_is_not_repeated_in_every_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    searched: list[int] = []

    def search(*_: object) -> list[float]:
        searched.append(finger.frames)
        return likely_rotations_deg(*_)  # type: ignore[arg-type]

    monkeypatch.setattr(texture_tracker, "likely_rotations_deg", search)
    finger = Finger("key", 5)
    finger.lose(22)
    finger.show("ring")
    first = finger.frames + 1
    for _ in range(8):
        assert finger.see(0.0).rotation_deg is None
    assert searched == [first, first + 4]  # `SEARCH_S` at 60 Hz


def regained(tracker: RotationTracker, rotations: list[float], from_s: float) -> list[RotationEstimate]:
    return [tracker.accept(from_s + k * FRAME_S, RotationEstimate(deg, 0.1)) for k, deg in enumerate(rotations)]


def test_a_rotation_that_wanders_after_a_gap_is_not_given() -> None:
    tracker = RotationTracker()
    tracker.start(0.0)
    wandering = regained(tracker, [-20.0, 5.0, -20.0, 30.0, -20.0, 12.0], GAP_S + FRAME_S)
    assert {one.rotation_deg for one in wandering} == {None}
    later_s = GAP_S + 10 * FRAME_S
    assert [one.rotation_deg for one in regained(tracker, [-20.0, -20.0, -20.0], later_s)] == [None, None, -20.0]


def test_a_rotation_close_to_the_last_one_needs_no_confirmation() -> None:
    tracker = RotationTracker()
    tracker.start(0.0)
    assert tracker.accept(1.0, RotationEstimate(1.5, 0.1)).rotation_deg == 1.5


def test_an_axis_that_flips_sign_near_90_degrees_agrees_with_itself() -> None:
    tracker = RotationTracker()
    tracker.start(0.0)
    offers = [one.unconfirmed for one in regained(tracker, [89.5, -89.5, 89.8], 0.3)]
    assert offers[:2] == [None, None]
    assert offers[2] is not None
    assert offers[2].axial
    assert offers[2].rotation_deg == pytest.approx(89.8)
