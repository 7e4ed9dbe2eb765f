"""The lag between two streams of one motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from slipguard.evaluation.clock_alignment import between_frames, find_lag

FRAME_S = 1 / 30


def rotation_at(time_s: np.ndarray) -> np.ndarray:
    return 15.0 * np.clip(time_s - 1.0, 0.0, 1.4) ** 1.3 + 0.8 * np.sin(2.0 * time_s) * (time_s > 1.0)


def streams(lag_s: float, noise_deg: float, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    camera_s = np.arange(0.0, 3.2, FRAME_S)
    tactile_s = np.arange(0.2, 3.0, 1 / 60) + rng.normal(0.0, 1e-3, 168)
    camera = rotation_at(camera_s - lag_s) + rng.normal(0.0, noise_deg / 4, len(camera_s))
    return camera_s, camera, tactile_s, rotation_at(tactile_s) + 0.7 + rng.normal(0.0, noise_deg, len(tactile_s))


@settings(max_examples=40, deadline=None)
@given(lag_s=st.floats(-0.3, 0.3), seed=st.integers(0, 1000))
def test_the_lag_is_found_within_half_a_frame(lag_s: float, seed: int) -> None:
    found = find_lag(*streams(lag_s, 0.3, seed))
    assert found.why is None
    assert abs(found.lag_s - lag_s) < FRAME_S / 2


def test_a_video_started_ten_seconds_earlier_is_found_too() -> None:
    camera_s, camera, tactile_s, tactile = streams(0.04, 0.2, 1)
    found = find_lag(camera_s + 10.0, camera, tactile_s, tactile, lag_max_s=30.0)
    assert found.lag_s == pytest.approx(10.04, abs=FRAME_S / 2)


def test_without_motion_there_is_no_lag() -> None:
    camera_s, camera, tactile_s, _ = streams(0.0, 0.1, 2)
    still = find_lag(camera_s, np.zeros_like(camera), tactile_s, np.zeros_like(tactile_s))
    assert still.why == "too little rotation"
    assert still.lag_s == 0.0


def test_streams_without_overlap_are_reported() -> None:
    camera_s, camera, tactile_s, tactile = streams(0.0, 0.1, 3)
    apart = find_lag(camera_s + 60.0, camera, tactile_s, tactile)
    assert apart.why == "the two streams do not overlap"


def test_a_lag_at_the_edge_of_the_search_range_is_rejected() -> None:
    edge = find_lag(*streams(0.45, 0.1, 4), lag_max_s=0.3)
    assert edge.why is not None
    assert edge.lag_s == 0.0


def test_nothing_is_known_in_a_gap() -> None:
    camera_s = np.concatenate([np.arange(0.0, 1.0, FRAME_S), np.arange(1.5, 2.5, FRAME_S)])
    times = np.array([-0.1, 0.5, 1.0, 1.2, 1.45, 1.6, 2.4, 2.7])
    assert between_frames(times, camera_s).tolist() == [False, True, False, False, False, True, True, False]


def test_the_lag_is_found_with_a_gap_during_the_rotation() -> None:
    camera_s, camera, tactile_s, tactile = streams(0.06, 0.2, 5)
    seen = (camera_s < 1.5) | (camera_s > 2.0)
    assert find_lag(camera_s[seen], camera[seen], tactile_s, tactile).lag_s == pytest.approx(0.06, abs=FRAME_S / 2)
