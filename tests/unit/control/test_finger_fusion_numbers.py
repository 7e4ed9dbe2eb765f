"""Values that are not finite give no rotation instead of a wrong one."""

from __future__ import annotations

import math

import pytest
from observations import estimate as said

from slipguard.control.finger_fusion import fuse


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, 1e308])
@pytest.mark.parametrize("field", ["rotation_deg", "sigma_deg", "rate_deg_s"])
def test_a_finger_with_values_that_are_not_finite_is_declined(field: str, bad: float) -> None:
    values = {"rotation_deg": 10.0, "sigma_deg": 0.5, "rate_deg_s": 0.0, field: bad}
    fused = fuse(said(**values), said(-12.0, rate_deg_s=0.0))  # type: ignore[arg-type]
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(12.0)
    assert fused.fingers == ("right",)
    assert fused.note == "left finger: not a number"
    assert fused.left_contact


def test_a_finger_without_a_capture_time_is_ignored() -> None:
    fused = fuse(said(10.0, at_s=math.nan), said(-12.0))
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(12.0)
    assert fused.left_contact is None
    assert fuse(said(10.0, at_s=math.inf), None) is None


def test_a_shift_that_is_not_finite_is_ignored() -> None:
    fused = fuse(said(10.0, shift_mm=(0.0, math.nan)), said(-10.0, shift_mm=(0.0, -0.5)))
    assert fused is not None
    assert fused.shift_mm == pytest.approx(0.5)


def test_a_finger_without_a_rate_uses_that_of_the_other() -> None:
    fused = fuse(said(10.0, at_s=1.0, rate_deg_s=100.0), said(-12.0, at_s=1.02))
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(10.0)
    assert fused.fingers == ("left", "right")


def test_without_any_rate_the_older_finger_is_ignored() -> None:
    fused = fuse(said(10.0, at_s=1.0), said(-30.0, at_s=1.05))
    assert fused is not None
    assert fused.rotation_deg == pytest.approx(30.0)
    assert fused.fingers == ("right",)
    assert fused.note == "left finger: older, and its rate is unknown"
