"""Only noise counts as unchanged, skipping starts after rest, and no slip is detected later because of it."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from test_gate import camera, glow, press

from slipguard.perception.skipping import (
    AVERAGED,
    DEFAULT_NOISE_BGR,
    QUIET_S,
    ChangeDetector,
    ContactGate,
    block_means,
    blocks_near,
)

NEAR = blocks_near(np.pad(np.ones((120, 100), np.uint8), ((100, 100), (70, 70))))


DENT = press(press(glow(), 60, 40, (120, 130)), 50, 15, (120, 200))


FRAME_S = 1 / 60


def still_on(scene: NDArray[np.float64], rng: np.random.Generator, frames: int = AVERAGED) -> ChangeDetector:
    gate = ContactGate(glow().astype(np.uint8), DEFAULT_NOISE_BGR)
    still = ChangeDetector(gate)
    for k in range(frames):
        still.add(block_means(camera(scene, rng)), NEAR, k * FRAME_S, k > 0)
    return still


def rotated(degrees: float) -> NDArray[np.float64]:
    """The dent, its smaller end rotated about its middle."""
    a = np.radians(degrees)
    return press(press(glow(), 60, 40, (120, 130)), 50, 15, (120 + 70 * np.sin(a), 130 + 70 * np.cos(a)))


def test_noise_and_flickering_columns_are_no_change() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        still = still_on(DENT, rng)
        columns = [DENT + rng.normal(0.0, 0.8, (1, 240, 3)) for _ in range(10)]
        assert sum(still.unchanged(block_means(camera(scene, rng))) for scene in columns) >= 9


@pytest.mark.parametrize("degrees", [1.0, -1.0, 5.0, 40.0])
def test_a_degree_is_a_change(degrees: float) -> None:
    rng = np.random.default_rng(4)
    still = still_on(DENT, rng)
    assert still.at_rest(5.0, with_rotation=True)
    assert not any(still.unchanged(block_means(camera(rotated(degrees), rng))) for _ in range(20))


def test_a_shift_by_a_pixel_and_a_spot_far_away_are_changes() -> None:
    rng = np.random.default_rng(4)
    still = still_on(DENT, rng)
    for scene in (np.roll(DENT, 1, axis=1), np.roll(DENT, 1, axis=0), press(DENT, 40, 12, (30, 290))):
        assert not any(still.unchanged(block_means(camera(scene, rng))) for _ in range(20))


def test_creep_accumulates_until_it_is_detected() -> None:
    rng = np.random.default_rng(5)
    still = still_on(DENT, rng)
    shown = [still.unchanged(block_means(camera(rotated(0.02 * k), rng))) for k in range(60)]
    assert shown[:5] == [True] * 5
    assert not any(shown[50:])


def test_rest_begins_half_a_second_after_a_change() -> None:
    rng = np.random.default_rng(6)
    still = still_on(DENT, rng)
    assert not still.at_rest(QUIET_S - FRAME_S, with_rotation=True)
    assert still.at_rest(QUIET_S + FRAME_S, with_rotation=True)
    still.add(block_means(camera(DENT, rng)), NEAR, 60.0, unchanged=False)
    assert not still.at_rest(60.0 + 2.0, with_rotation=True)  # one image alone is too noisy to compare with
    assert not still.at_rest(59.0, with_rotation=True)


def test_a_faint_contact_is_not_sensitive_enough_to_skip() -> None:
    rng = np.random.default_rng(7)
    faint = press(glow(), 1.5, 40, (120, 160))
    assert not still_on(faint, rng).at_rest(5.0, with_rotation=True)
    assert still_on(DENT, rng).at_rest(5.0, with_rotation=True)


def test_nothing_is_unchanged_without_a_kept_image() -> None:
    rng = np.random.default_rng(8)
    still = still_on(DENT, rng)
    blocks = block_means(camera(DENT, rng))
    assert still.unchanged(blocks)
    still.reset()
    assert not still.unchanged(blocks)
    assert not still.at_rest(100.0, with_rotation=False)


def test_a_camera_that_becomes_noisy_counts_as_a_change() -> None:
    rng = np.random.default_rng(9)
    still = still_on(DENT, rng)
    noisy = [DENT + 12.0 * rng.standard_normal(DENT.shape) for _ in range(10)]
    assert not any(still.unchanged(block_means(camera(scene, rng))) for scene in noisy)
