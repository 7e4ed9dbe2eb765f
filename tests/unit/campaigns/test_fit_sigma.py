"""The fit of sigma's constants finds those that errors were drawn from, and its table counts what lies within."""

from __future__ import annotations

import numpy as np
import pytest

from slipguard.datasets.effect_scenes import render_effect
from slipguard.perception.gel_memory import ImprintMemory
from slipguard.perception.registration import Ghost, Registration, TexturePose
from slipguard.perception.segmenter import Segmenter
from tests.campaigns.fit_sigma import RotationSample, constants_in_use, fitted, samples, table, using

SPREAD = ("registration", "SPREAD")


def drawn(count: int, spread: float, seed: int, effect: str = "clean") -> list[RotationSample]:
    """Return rotations with Gaussian errors of `spread` times the disagreement of the contact's parts."""
    rng = np.random.default_rng(seed)
    out = []
    for _ in range(count):
        parts_deg = float(np.exp(rng.uniform(np.log(0.1), np.log(1.0))))
        best = Registration(TexturePose(10.0), parts_deg, 0.0, 0.0, 0.0, 1.0, 50.0, Ghost(0.0, 0.01, 0.0))
        out.append(RotationSample(effect, 10.0 + float(rng.normal(0.0, spread * parts_deg)), best, ImprintMemory()))
    return out


@pytest.mark.parametrize("spread", [0.7, 3.0])
def test_the_share_that_errors_were_drawn_from_is_found(spread: float) -> None:
    before = constants_in_use()
    # Student's t in place of Gauss makes it a little smaller.
    assert fitted(drawn(800, spread, 1))[SPREAD] == pytest.approx(0.93 * spread, rel=0.12)
    assert constants_in_use() == before


def test_effects_have_equal_weight() -> None:
    few, many = drawn(200, 4.0, 1, "rocking"), drawn(1000, 1.0, 2, "clean")
    assert fitted([*few, *many])[SPREAD] > 1.3 * fitted([*few, *many[:200], *drawn(800, 1.0, 3, "rocking")])[SPREAD]


def test_the_table_counts_what_is_declined_within_and_beyond() -> None:
    found = drawn(400, 1.0, 2)
    none = RotationSample("clean", 0.0, None, ImprintMemory())
    (line,) = table([*found, *[none] * 100], {**constants_in_use(), SPREAD: 1.0})
    assert "n   500" in line
    assert "declined 20.0%" in line
    (line,) = table(found, {**constants_in_use(), SPREAD: 1e-3})
    assert "declined  0.0%" in line
    assert float(line.split(" 4 ")[1].split("%")[0]) > 40.0
    assert table([none], constants_in_use()) == ["clean        n     1, all declined"]


def test_a_rendered_grasp_gives_samples_near_its_truth() -> None:
    found = list(samples("clean", render_effect("clean", "tee", 8300), Segmenter()))
    assert len(found) > 20
    with using({SPREAD: 1.0}):
        errors = [abs((one.measured().rotation_deg or 0.0) - one.rotation_deg) for one in found]
    assert np.mean(errors) < 0.3
