"""The renderer against real presses of a ball that it was not fitted to."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ball_presses import BALL_RADIUS_MM, correlation, drawn_difference, read_presses, refined_pose

from slipguard.sim.sensor_unit import SensorUnit

FITTED_PRESSES = 15


@pytest.mark.real
def test_rendered_presses_resemble_held_out_real_ones(real_data: Path) -> None:
    presses = read_presses(real_data / "taxim_sphere")[FITTED_PRESSES:]
    assert len(presses) == 15
    unit = SensorUnit()
    values = []
    for press in presses:
        pose = refined_pose(unit, BALL_RADIUS_MM, press, rounds=6)
        values.append(correlation(press, drawn_difference(unit, BALL_RADIUS_MM, press, pose)))
    assert np.mean(values) >= 0.85
    assert min(values) >= 0.70


@pytest.mark.real
def test_swapping_red_and_blue_changes_the_score(real_data: Path) -> None:
    presses = read_presses(real_data / "taxim_sphere")[FITTED_PRESSES::5]
    unit = SensorUnit()
    for press in presses:
        pose = refined_pose(unit, BALL_RADIUS_MM, press, rounds=6)
        drawn = drawn_difference(unit, BALL_RADIUS_MM, press, pose)
        assert correlation(press, drawn[..., ::-1].copy()) < 0.4
