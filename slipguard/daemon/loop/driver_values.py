"""Check what drivers return: an invalid value is an error of the driver and never reaches the controller."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import fields
from typing import Any, TypeVar

from slipguard.devices import ArmState, Frame, GripperState, wrong_image

S = TypeVar("S", GripperState, ArmState)
AHEAD_MAX_S = 1.0
"""A state from further in the future has the time of another clock: its silence would never be noticed."""


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool) and math.isfinite(value)


def _is_position(value: object) -> bool:
    return value is None or (isinstance(value, (tuple, list)) and len(value) == 3 and all(map(_is_number, value)))


VALID: dict[str, tuple[Callable[[object], bool], str]] = {
    "float": (_is_number, "a finite number (float)"),
    "bool": (lambda value: isinstance(value, bool), "True or False (bool)"),
    "str | None": (lambda value: value is None or (isinstance(value, str) and value != ""), "a text (str) or None"),
    "tuple[float, float, float] | None": (_is_position, "three finite numbers or None"),
}
"""By annotation of a field: whether a value is valid, and what it must be."""


def checked_gripper_state(state: GripperState, now_s: float) -> GripperState:
    """Return the state of a gripper. Raises TypeError or ValueError with the field that is not valid."""
    return _checked_state(state, GripperState, now_s)


def checked_arm_state(state: ArmState, now_s: float) -> ArmState:
    """Return the state of an arm. Raises TypeError or ValueError with the field that is not valid."""
    return _checked_state(state, ArmState, now_s)


def _checked_state(state: S, kind: type[S], now_s: float) -> S:
    if not isinstance(state, kind):
        raise TypeError(f"state() returned {type(state).__name__}, not {kind.__name__}")
    for one in fields(kind):
        value, (is_valid, expected) = getattr(state, one.name), VALID[str(one.type)]
        if not is_valid(value):
            raise ValueError(f"state().{one.name} is {value!r}; it must be {expected}")
    ahead_s = state.measured_at_s - now_s
    if ahead_s > AHEAD_MAX_S:
        raise ValueError(
            f"state().measured_at_s is {ahead_s:.0f} s in the future; use asyncio.get_running_loop().time()"
        )
    return state


def checked_frame(frame: Any) -> Frame:
    """Return the frame of a sensor. Raises TypeError or ValueError with what is not valid."""
    if not isinstance(frame, Frame):
        raise TypeError(f"next_frame() returned {type(frame).__name__}, not Frame")
    wrong = wrong_image(frame.image)
    if wrong is not None:
        raise TypeError(f"next_frame().image is {wrong}")
    if not _is_number(frame.captured_at_s):
        raise ValueError(f"next_frame().captured_at_s is {frame.captured_at_s!r}; it must be a finite number")
    if not isinstance(frame.sequence, int):
        raise TypeError(f"next_frame().sequence is {frame.sequence!r}; it must be a whole number (int)")
    return frame
