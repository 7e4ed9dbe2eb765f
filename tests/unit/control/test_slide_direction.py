"""The direction of a slide relative to gravity, from the orientation of the arm's tool."""

from __future__ import annotations

import math

import pytest
from controller_steps import Play
from observations import fused, guard_params
from records import changed

from slipguard.control.slide_direction import slide_direction

POINTS_UP, POINTS_DOWN = (0.0, 0.0, 0.0), (0.0, math.pi, 0.0)
LEVEL = (0.0, 0.5 * math.pi, 0.0)
UP = "upwards, not by its weight"


@pytest.mark.parametrize(
    ("orientation_rad", "down", "right", "up"),
    [
        (POINTS_DOWN, "downwards", "sideways", UP),
        ((0.0, 0.8 * math.pi, 0.0), "downwards", "sideways", UP),
        ((math.pi * math.cos(0.4), math.pi * math.sin(0.4), 0.0), "downwards", "sideways", UP),
        (POINTS_UP, UP, "sideways", "downwards"),
        ((0.0, 0.0, 2.0), UP, "sideways", "downwards"),
        (LEVEL, "sideways", "", "sideways"),
        ((0.0, 0.7 * math.pi, 0.0), "sideways", "", "sideways"),
        (None, "", "", ""),
    ],
)
def test_a_slide_has_the_direction_that_the_tools_orientation_says(
    orientation_rad: tuple[float, float, float] | None, down: str, right: str, up: str
) -> None:
    assert slide_direction(2.0, 0.5, orientation_rad) == down
    assert slide_direction(0.5, -2.0, orientation_rad) == right
    assert slide_direction(-2.0, 0.5, orientation_rad) == up


@pytest.mark.parametrize(
    ("orientation_rad", "shift", "reported"),
    [
        (POINTS_DOWN, {"shift_mm": 3.1}, "moved 3.1 mm downwards:"),
        (POINTS_DOWN, {"shift_mm": -3.1}, f"moved 3.1 mm {UP}:"),
        (POINTS_DOWN, {"shift_mm": 0.0, "sideways_mm": 3.1}, "moved 3.1 mm sideways:"),
        (LEVEL, {"shift_mm": 3.1}, "moved 3.1 mm sideways:"),
        (LEVEL, {"shift_mm": 0.0, "sideways_mm": 3.1}, "moved 3.1 mm:"),
        (None, {"shift_mm": 3.1}, "moved 3.1 mm:"),
    ],
)
def test_a_slide_is_answered_and_reported_with_its_direction(
    orientation_rad: tuple[float, float, float] | None, shift: dict[str, float], reported: str
) -> None:
    play = Play(guard_params()).held()
    play.here = changed(play.here, orientation_rad=orientation_rad)
    play.view = changed(fused(), sideways_mm=0.0)
    play.steps(0.1)
    play.view = changed(play.view, **shift)
    texts = [output.text or "" for output in play.steps(0.1) if output.hold_force_n is not None]
    assert texts
    assert reported in texts[0]
