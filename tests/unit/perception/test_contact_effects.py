"""What a real contact does in addition to rotating rigidly never gives a wrong rotation with a small sigma."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from slipguard.datasets.effect_scenes import EffectName, render_effect
from slipguard.perception.contact.patch import find_patch
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.rotation.gel_memory import SHARE_MAX, ImprintMemory
from slipguard.perception.rotation.texture_map import ImageWindow, TextureMap
from slipguard.perception.rotation.texture_registration import Ghost, local_changes
from slipguard.perception.rotation.texture_template import NEAR_PX, TextureTemplate, make_texture_template
from slipguard.perception.settings import PerceptionSettings


def errors(effect: EffectName, case: str, seed: int, level: float | None = None) -> tuple[list[float], list[float]]:
    """Return the errors in degrees and in sigmas of a grasp's estimates."""
    grasp = render_effect(effect, case, seed, level)
    pipeline = Pipeline(Segmenter(), PerceptionSettings(), grasp.background, grasp.noise_bgr, grasp.px_per_mm)
    errors_deg, errors_sigma = [], []
    for shot in grasp.shots:
        estimate = pipeline.process(shot.frame)
        if shot.compared and estimate.rotation_deg is not None and estimate.sigma_deg is not None:
            errors_deg.append(abs(estimate.rotation_deg - shot.rotation_deg))
            errors_sigma.append(errors_deg[-1] / estimate.sigma_deg)
    return errors_deg, errors_sigma


def test_gel_memory_is_detected_and_corrected() -> None:
    errors_deg, errors_sigma = errors("memory", "bar", 1, 0.4)
    assert len(errors_deg) > 20
    assert max(errors_sigma) < 4.0
    assert sum(errors_deg) / len(errors_deg) < 0.4


@pytest.mark.parametrize(("case", "seed"), [("key", 31049), ("bar", 31582)])
def test_the_contour_of_a_gel_that_remembers_never_counts_alone(case: str, seed: int) -> None:
    """The share of a strong memory seemed too large for the texture in some frames: the contour was 4 to 6 sigma off.

    Before a memory is certain, the contour is as uncertain as the texture: the bar was 3.5 sigma off.
    """
    errors_deg, errors_sigma = errors("memory", case, seed, 0.4)
    assert len(errors_deg) == 36
    assert max(errors_sigma) < 3.0


def test_a_hook_that_tilts_without_rotating_is_not_taken_for_memory() -> None:
    errors_deg, errors_sigma = errors("rocking", "hook", 31046, 2.0)
    assert len(errors_deg) == 36
    assert max(errors_sigma) < 2.0


def test_partial_slip_is_declined_or_uncertain() -> None:
    _, errors_sigma = errors("partial slip", "bracket", 504, 9.0)
    assert max(errors_sigma, default=0.0) < 4.0


def test_rays_on_a_rim_are_not_taken_for_the_next_ones_after_frames_that_deform() -> None:
    """The coin has 60 rays; after some declined frames it was found two rays further on, 13 degrees off."""
    errors_deg, errors_sigma = errors("partial slip", "coin", 8101)
    assert len(errors_deg) >= 8
    assert max(errors_deg) < 2.0
    assert max(errors_sigma) < 3.0


@pytest.mark.parametrize("seed", [40939, 41739])
def test_the_sixths_of_a_nut_are_counted_however_lightly_it_is_pressed(seed: int) -> None:
    """Some of its six edges touch less: it was not taken for periodic, and was 60 degrees off after declined frames."""
    errors_deg, errors_sigma = errors("periodic", "nut", seed, 7500.0)
    assert len(errors_deg) >= 9
    assert max(errors_sigma) < 3.0


@pytest.mark.parametrize(("effect", "case"), [("partial slip", "hook"), ("rocking", "banana"), ("rocking", "key")])
def test_a_middle_that_slips_and_a_body_that_rolls_are_within_sigma(effect: EffectName, case: str) -> None:
    errors_deg, errors_sigma = errors(effect, case, 500)
    assert len(errors_deg) > 15
    assert max(errors_sigma) < 3.0


@pytest.mark.parametrize(
    ("effect", "case", "seed"),
    [
        ("partial slip", "wedge", 9100),  # its middle lags behind, and then all that is seen follows the middle
        ("partial slip", "screwdriver", 9100),  # after a gap its texture fits at two rotations, its contour lags
        ("rocking", "banana", 9605),  # rolls in the first frame of its motion
    ],
)
def test_what_has_slipped_or_rolled_unseen_stays_in_sigma(effect: EffectName, case: str, seed: int) -> None:
    errors_deg, errors_sigma = errors(effect, case, seed)
    assert len(errors_deg) > 15
    assert max(errors_sigma) < 3.0


def test_a_middle_that_has_lagged_stays_in_sigma_while_the_object_rests() -> None:
    errors_deg, errors_sigma = errors("partial slip", "hook", 31548, 9.0)
    assert len(errors_deg) >= 28
    assert max(errors_sigma) < 3.0


@pytest.mark.parametrize(("seed", "tilt_deg"), [(31036, 8.0), (20136, 4.0)])
def test_a_bowed_edge_that_slides_along_itself_fits_at_several_rotations(seed: int, tilt_deg: float) -> None:
    """Tilted back, a knife's edge was found further along its bow: 2.7 degrees off at a sigma of 0.3, 1.9 at 0.2."""
    errors_deg, errors_sigma = errors("rocking", "knife_edge", seed, tilt_deg)
    assert len(errors_deg) > 30
    assert max(errors_sigma) < 3.5


def test_a_middle_that_rotates_by_itself_and_a_stronger_side_are_measured() -> None:
    template = texture_template()
    weight = np.ones(len(template.value), np.float32)
    rigid = np.asarray(0.05 * template.motion[0] + 0.3 * template.motion[1], np.float32)
    assert local_changes(template, weight, rigid) == (pytest.approx(0.0, abs=0.05), pytest.approx(0.0, abs=0.01))
    near = np.exp(-(template.x_px**2 + template.y_px**2) / NEAR_PX**2)
    middle = np.asarray(np.radians(4.0) * template.motion[0] * near, np.float32)
    assert local_changes(template, weight, rigid + middle)[0] > 1.0
    size_px = np.sqrt(np.mean(template.x_px**2 + template.y_px**2))
    stronger = np.asarray(0.3 * template.value * template.x_px / size_px, np.float32)
    assert local_changes(template, weight, rigid + stronger)[1] == pytest.approx(0.3, abs=0.05)


def texture_template() -> TextureTemplate:
    rng = np.random.default_rng(3)
    probability = np.zeros((160, 120), np.float32)
    probability[50:110, 35:85] = 1.0
    patch = find_patch(probability, 0.5, 100, 2.0)
    assert patch is not None
    curvature = cv2.GaussianBlur(rng.normal(0.0, 30.0, (160, 120)).astype(np.float32), (0, 0), 2.0)
    template = make_texture_template(TextureMap(ImageWindow(0, 0, 120, 160), np.asarray(curvature, np.float32)), patch)
    assert template is not None
    return template


def test_memory_is_certain_after_some_frames_and_then_corrects() -> None:
    memory = ImprintMemory()
    ghost = Ghost(0.3, 0.06, 5.0)
    first = memory.corrected(10.0, 0.1, ghost)
    assert (first.rotation_deg, first.sigma_deg) == (10.0, pytest.approx(1.5, abs=0.01))
    for _ in range(12):
        memory.update(ghost)
    assert memory.certain
    corrected = memory.corrected(10.0, 0.1, ghost)
    assert corrected.rotation_deg == pytest.approx(11.5, abs=0.05)
    assert corrected.sigma_deg is not None
    assert corrected.sigma_deg < 0.6


def test_a_frame_that_shows_nothing_of_it_teaches_nothing() -> None:
    memory = ImprintMemory()
    memory.update(Ghost(5.0, float("inf"), 0.0))
    assert memory.share == 0.0
    assert not memory.certain


def test_memory_is_certain_only_after_a_frame_that_can_show_it() -> None:
    memory = ImprintMemory()
    for _ in range(60):
        memory.update(Ghost(1.2, 0.3, 0.1, shown=False))
    assert memory.share > 0.5
    assert not memory.certain
    memory.update(Ghost(0.7, 0.1, 0.5))
    assert memory.certain


def test_a_gel_that_mostly_shows_the_past_is_recognized() -> None:
    memory = ImprintMemory()
    for _ in range(12):
        memory.update(Ghost(SHARE_MAX + 0.1, 0.05, 5.0))
    assert memory.too_strong
