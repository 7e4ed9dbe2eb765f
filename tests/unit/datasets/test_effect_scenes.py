"""Scenes with one effect: their truth, their repeatability, and that they contain the effect."""

from __future__ import annotations

import numpy as np
import pytest
from sampled import sampled

from slipguard.datasets.effect_scenes import EFFECTS, SHAFTS, EffectName, effect_cases, render_effect
from slipguard.errors import InputError


@pytest.mark.parametrize("effect", sampled(EFFECTS))
def test_a_scene_is_the_same_for_the_same_seed(effect: EffectName) -> None:
    case = effect_cases(effect)[0]
    first, second, other = (render_effect(effect, case, seed) for seed in (1, 1, 2))
    assert all(np.array_equal(a.frame.image, b.frame.image) for a, b in zip(first.shots, second.shots, strict=True))
    assert not np.array_equal(first.shots[-1].frame.image, other.shots[-1].frame.image)
    assert not first.shots[0].contact
    assert [shot.rotation_deg for shot in first.shots if not shot.compared] == [0.0] * 16
    assert sum(shot.compared for shot in first.shots) >= 7


def test_an_effect_changes_the_image_and_not_the_truth() -> None:
    weak, strong = (render_effect("partial slip", "bar", 3, level) for level in (0.01, 9.0))
    assert [shot.rotation_deg for shot in weak.shots] == [shot.rotation_deg for shot in strong.shots]
    last = [scene.shots[-1].frame.image.astype(float) for scene in (weak, strong)]
    assert np.abs(last[0] - last[1]).max() > 20.0


def test_shafts_slide_and_do_not_rotate() -> None:
    scene = render_effect("periodic", next(iter(SHAFTS)), 1, 9810.0)
    compared = [shot for shot in scene.shots if shot.compared]
    assert {shot.rotation_deg for shot in compared} == {0.0}
    ways_mm = [float(np.hypot(*shot.shift_mm)) for shot in compared if shot.shift_mm is not None]
    assert len(ways_mm) == len(compared)
    assert ways_mm == sorted(ways_mm)
    assert 10.0 < ways_mm[-1] <= 30.0


def test_an_unknown_effect_is_rejected() -> None:
    with pytest.raises(InputError, match="there are: clean"):
        render_effect("wind", "bar", 1)  # type: ignore[arg-type]
