"""The mechanics behind the emulated registers: the motor and the object between the jaws.

`JawsPlant` is the interface between the emulated gripper and its mechanics, so that an emulated cell can use its own
world. Widths are mm between the fingers, forces newtons per finger; the caller's times never decrease.
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

RAMP_N_S = 400.0
"""Rise of the force after the fingers have reached an object; published values are 64 to 480 N/s."""
DEAD_TIME_S = 0.02
"""From a command to the first motion: 20 to 60 ms."""
OVERRIDE_S = 0.01
"""A beginning motion ignores the force setting for a "short period" (manual of the 3-Finger gripper); an assumption."""


@dataclass(frozen=True, slots=True)
class JawsState:
    """The jaws at one time. force_n: on each side of the object; 0 without an object.

    met_closing: an object stopped the motor while closing. Nothing stops it while opening.
    """

    width_mm: float
    force_n: float = 0.0
    moving: bool = False
    met_closing: bool = False

    @property
    def holds(self) -> bool:
        """Whether an object is held."""
        return self.force_n > 0.0


class JawsPlant(Protocol):
    """The mechanics that the emulated gripper's motor moves."""

    @abstractmethod
    def drive(self, now_s: float, width_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start the motor toward a width; it stops there, or when an object resists with `force_n`.

        Closing on a held object tightens the grip to `force_n`; a lower force has no effect because of the screw.
        """

    @abstractmethod
    def halt(self, now_s: float) -> None:
        """Stop the motor; the screw keeps force and width."""

    @abstractmethod
    def state_at(self, now_s: float) -> JawsState:
        """Return the state at a time."""


class SimpleJaws(JawsPlant):
    """Jaws with at most one rigid object between them.

    object_mm: its width; None: no object. It may be changed at any time; a removed object is no longer pressed.
    fingertip_mm: thickness of a sensor on each finger; the jaws stop twice this earlier, without an object gel on gel.
    """

    def __init__(self, stroke_mm: float = 85.0, object_mm: float | None = None, fingertip_mm: float = 0.0) -> None:
        self.stroke_mm = stroke_mm
        self.object_mm = object_mm
        self.fingertip_mm = fingertip_mm
        self._width_mm = stroke_mm
        self._force_n = 0.0
        self._goal_mm: float | None = None
        """Goal of the motor; None at rest."""
        self._limit_n = 0.0
        self._speed_mm_s = 0.0
        self._at_s = 0.0
        self._limited_from_s = 0.0
        """From then on the force setting limits the present motion."""
        self._met_closing = False

    def drive(self, now_s: float, width_mm: float, speed_mm_s: float, force_n: float) -> None:
        """See `JawsPlant`."""
        self._advance(now_s)
        going_on = self._goal_mm is not None and (self._goal_mm < self._width_mm) == (width_mm < self._width_mm)
        self._goal_mm, self._speed_mm_s, self._limit_n = width_mm, speed_mm_s, force_n
        if not going_on:
            self._at_s = now_s + DEAD_TIME_S
            self._limited_from_s = self._at_s + OVERRIDE_S

    def halt(self, now_s: float) -> None:
        """See `JawsPlant`."""
        self._advance(now_s)
        self._goal_mm = None

    def state_at(self, now_s: float) -> JawsState:
        """See `JawsPlant`."""
        self._advance(now_s)
        return JawsState(self._width_mm, self._force_n, self._goal_mm is not None, self._met_closing)

    @property
    def _stops_at_mm(self) -> float | None:
        """Width at which object or gels stop the jaws; None if nothing does."""
        if self.object_mm is None and self.fingertip_mm == 0.0:
            return None
        return (self.object_mm or 0.0) + 2.0 * self.fingertip_mm

    def _advance(self, now_s: float) -> None:
        in_the_way_mm = self._stops_at_mm
        if self._force_n > 0.0 and (in_the_way_mm is None or in_the_way_mm < self._width_mm):
            self._force_n, self._met_closing = 0.0, False
        if self._goal_mm is None or now_s <= self._at_s:
            return
        step_s, self._at_s = now_s - self._at_s, now_s
        if self._goal_mm > self._width_mm:
            self._open(step_s, self._goal_mm)
        else:
            self._close(step_s, self._goal_mm)

    def _open(self, step_s: float, goal_mm: float) -> None:
        self._force_n, self._met_closing = 0.0, False
        self._width_mm = min(goal_mm, self._width_mm + self._speed_mm_s * step_s)
        if self._width_mm == goal_mm:
            self._goal_mm = None

    def _close(self, step_s: float, goal_mm: float) -> None:
        in_the_way_mm = self._stops_at_mm
        in_the_way = in_the_way_mm is not None and goal_mm < in_the_way_mm <= self._width_mm
        stop_mm = in_the_way_mm if in_the_way and in_the_way_mm is not None else goal_mm
        way_mm = self._speed_mm_s * step_s
        if self._width_mm - way_mm > stop_mm:
            self._width_mm -= way_mm
            return
        way_mm, self._width_mm = self._width_mm - stop_mm, stop_mm
        if not in_the_way:
            self._goal_mm, self._met_closing = None, False
            return
        pressing_s = self._at_s - (step_s - way_mm / self._speed_mm_s)
        overridden_s = min(max(self._limited_from_s - pressing_s, 0.0), self._at_s - pressing_s)
        limited_n = max(self._limit_n, self._force_n + RAMP_N_S * overridden_s)
        self._force_n = min(limited_n, self._force_n + RAMP_N_S * (self._at_s - pressing_s))
        if self._force_n >= self._limit_n and self._at_s >= self._limited_from_s:
            self._goal_mm, self._met_closing = None, True
