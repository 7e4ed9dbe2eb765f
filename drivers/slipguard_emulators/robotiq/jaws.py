"""The mechanics behind the emulated registers: what the motor does, and what is between the jaws.

`Jaws` is all that the emulated gripper asks of mechanics, so that a cell can put its own world there. Widths are mm
between the fingers, forces newtons per finger, times those of whoever calls (they never go back).
"""

from __future__ import annotations

from abc import abstractmethod
from dataclasses import dataclass
from typing import Protocol

RAMP_N_S = 400.0
"""How fast force rises once the fingers have met an object; published rises lie at 64 to 480 N/s."""
DEAD_TIME_S = 0.02
"""From an order to the first motion: 20 to 60 ms."""


@dataclass(frozen=True, slots=True)
class JawsState:
    """The jaws at one instant. force_n: what presses on each side of an object; 0 without one.

    met_closing, met_opening: an object stopped the motor on its way in, or out.
    """

    width_mm: float
    force_n: float = 0.0
    moving: bool = False
    met_closing: bool = False
    met_opening: bool = False

    @property
    def holds(self) -> bool:
        """Something would fall if the jaws opened."""
        return self.force_n > 0.0


class JawsPlant(Protocol):
    """What the emulated gripper's motor works on."""

    @abstractmethod
    def drive(self, now_s: float, width_mm: float, speed_mm_s: float, force_n: float) -> None:
        """Start the motor towards a width; it stops there, or where something resists with `force_n`.

        Closing on what is held already tightens the grip to `force_n`; a lower one loosens nothing (the screw).
        """

    @abstractmethod
    def halt(self, now_s: float) -> None:
        """Stop the motor where it is; the screw keeps force and width."""

    @abstractmethod
    def look(self, now_s: float) -> JawsState:
        """How the jaws are now."""


class SimpleJaws(JawsPlant):
    """Jaws with at most one hard object between them, and nothing else in the world.

    object_mm: its thickness; None: nothing. It may be changed at any time: an object taken away no longer presses.
    """

    def __init__(self, stroke_mm: float = 85.0, object_mm: float | None = None) -> None:
        self.stroke_mm = stroke_mm
        self.object_mm = object_mm
        self._width_mm = stroke_mm
        self._force_n = 0.0
        self._goal_mm: float | None = None
        """Where the motor is going; None at rest."""
        self._limit_n = 0.0
        self._speed_mm_s = 0.0
        self._at_s = 0.0
        self._met_closing = False

    def drive(self, now_s: float, width_mm: float, speed_mm_s: float, force_n: float) -> None:
        """See `Jaws`."""
        self._advance(now_s)
        going_on = self._goal_mm is not None and (self._goal_mm < self._width_mm) == (width_mm < self._width_mm)
        self._goal_mm, self._speed_mm_s, self._limit_n = width_mm, speed_mm_s, force_n
        self._at_s = self._at_s if going_on else now_s + DEAD_TIME_S

    def halt(self, now_s: float) -> None:
        """See `Jaws`."""
        self._advance(now_s)
        self._goal_mm = None

    def look(self, now_s: float) -> JawsState:
        """See `Jaws`."""
        self._advance(now_s)
        return JawsState(self._width_mm, self._force_n, self._goal_mm is not None, self._met_closing)

    def _advance(self, now_s: float) -> None:
        if self._force_n > 0.0 and (self.object_mm is None or self.object_mm < self._width_mm):
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
        in_the_way = self.object_mm is not None and goal_mm < self.object_mm <= self._width_mm
        stop_mm = self.object_mm if in_the_way and self.object_mm is not None else goal_mm
        way_mm = self._speed_mm_s * step_s
        if self._width_mm - way_mm > stop_mm:
            self._width_mm -= way_mm
            return
        way_mm, self._width_mm = self._width_mm - stop_mm, stop_mm
        if not in_the_way:
            self._goal_mm, self._met_closing = None, False
            return
        left_s = step_s - way_mm / self._speed_mm_s
        self._force_n = max(self._force_n, min(self._limit_n, self._force_n + RAMP_N_S * left_s))
        if self._force_n >= self._limit_n:
            self._goal_mm, self._met_closing = None, True
