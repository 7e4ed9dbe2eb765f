"""Which frames of a contact run the network: few at rest, few while it moves as a whole."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from types import ModuleType

import numpy as np
import pytest
from numpy.typing import NDArray

from slipguard.devices import Frame
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.estimate import Estimate
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation import contour_meter, period_count, shift_meter
from slipguard.perception.settings import PerceptionSettings
from slipguard.sim.catalogue import find_object
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit

FPS = 60.0
FIRST_FRAMES = 12
"""Before these have passed, the reference is taken."""


class CountedSegmenter(Segmenter):
    """Counts how often the network runs."""

    calls = 0

    def segment(self, image: NDArray[np.uint8], background: NDArray[np.uint8] | None) -> NDArray[np.float32]:
        self.calls += 1
        return super().segment(image, background)


def measured(
    name: str, frames: int, angle_deg: Callable[[float], float], growth: float = 0.0, slide_mm_s: float = 0.0
) -> tuple[int, list[tuple[Estimate, float]]]:
    """Return how often the network ran after the first frames, and each estimate since then with the true rotation.

    growth: by which share the object sinks deeper within the first 0.3 s. slide_mm_s: how fast it moves up.
    """
    unit = random_unit(np.random.default_rng(3))
    camera, segmenter = GelCamera(unit, seed=3), CountedSegmenter()
    pipeline = Pipeline(segmenter, PerceptionSettings(), camera.no_contact(), unit.noise_bgr, unit.px_per_mm)
    press_mm, first, found = 0.5 * find_object(name).press_mm, 0, []
    for k in range(FIRST_FRAMES + frames):
        if k == FIRST_FRAMES:
            first = segmenter.calls
        at_s = max(k - FIRST_FRAMES, 0) / FPS
        rotation_deg, depth_mm = angle_deg(at_s), press_mm * (1.0 + growth * min(at_s / 0.3, 1.0))
        view = GelView(name, 0.5, 0.5 + slide_mm_s * at_s, 30.0 + rotation_deg, depth_mm)
        estimate = pipeline.process(Frame(camera.draw(view), k / FPS, k))
        if k >= FIRST_FRAMES:
            found.append((estimate, rotation_deg))
    return segmenter.calls - first, found


def test_at_rest_the_network_runs_every_two_seconds() -> None:
    calls, found = measured("wrench", 130, lambda _: 0.0)
    assert calls <= 3
    assert all(estimate.rotation_deg == pytest.approx(0.0, abs=0.2) for estimate, _ in found)
    assert sum(estimate.skipped is None for estimate, _ in found) < 60


def test_after_a_glitch_of_one_image_the_estimate_from_before_it_is_valid_again() -> None:
    calls, found = measured("wrench", 100, lambda at_s: 3.0 if at_s == 90 / FPS else 0.0)
    assert calls <= 4
    before, glitch, after = (found[k][0] for k in (89, 90, 91))
    assert glitch.rotation_deg == pytest.approx(3.0, abs=0.3)
    assert after.rotation_deg == pytest.approx(0.0, abs=0.2)
    assert before.skipped is not None
    assert after.segmented is False or after.skipped is not None


def test_what_later_frames_may_need_is_computed_after_the_frame_of_the_reference(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    computed: list[str] = []

    def count(module: ModuleType, name: str) -> None:
        original = getattr(module, name)
        monkeypatch.setattr(module, name, lambda *given: (computed.append(name), original(*given))[1])

    count(contour_meter, "make_contour_template")
    count(shift_meter, "shift_period")
    count(period_count, "repeats_after_deg")
    unit = random_unit(np.random.default_rng(3))
    camera = GelCamera(unit, seed=3)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), camera.no_contact(), unit.noise_bgr, unit.px_per_mm)
    view = GelView("wrench", 0.5, 0.5, 30.0, 0.5 * find_object("wrench").press_mm)
    for k in range(24):
        had_reference = pipeline.has_reference
        pipeline.process(Frame(camera.draw(view), k / FPS, k))
        if not had_reference:
            assert not computed
    assert sorted(computed) == ["make_contour_template", "repeats_after_deg", "shift_period"]


def test_a_texture_that_is_uncertain_carries_the_rotation_on() -> None:
    calls, found = measured("bar", 48, lambda at_s: 25.0 * at_s, growth=0.4)
    uncertain = [one for one, _ in found if not one.segmented and (one.sigma_deg or 0.0) > 0.8]
    assert calls <= 8
    assert len(uncertain) >= 10
    for estimate, rotation_deg in found:
        assert estimate.rotation_deg is not None
        assert estimate.sigma_deg is not None
        assert abs(estimate.rotation_deg - rotation_deg) < 3.0 * estimate.sigma_deg


def test_a_smooth_shaft_runs_the_network_on_every_second_frame() -> None:
    calls, found = measured("screwdriver", 24, lambda at_s: 40.0 * at_s)
    assert calls <= 16
    for before, now in pairwise([estimate for estimate, _ in found]):
        assert before.segmented or now.segmented or now.skipped is not None, "a slide is seen one frame later at most"
    for estimate, rotation_deg in found:
        if estimate.rotation_deg is not None and estimate.sigma_deg is not None:
            assert abs(estimate.rotation_deg - rotation_deg) < 3.0 * estimate.sigma_deg


def test_a_round_contact_runs_few_networks_and_its_shift_is_still_measured() -> None:
    calls, found = measured("ring", 24, lambda _: 0.0, slide_mm_s=4.0)
    assert calls <= 12
    shifts = [estimate.shift_mm[1] for estimate, _ in found if estimate.shift_mm is not None]
    assert len(shifts) == len(found)
    assert all(estimate.decline_reason == "round contact" for estimate, _ in found)
    assert shifts[-1] - shifts[0] == pytest.approx(4.0 * 23 / FPS, abs=0.15)
