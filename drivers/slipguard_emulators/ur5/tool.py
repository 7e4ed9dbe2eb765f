"""The tool that the emulated controller moves: an interface and its two implementations.

Poses are (x, y, z, rx, ry, rz): meters and a rotation vector in radians, in the frame of the arm's base; velocities are
meters and radians per second. Times are seconds on the loop's clock.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Protocol

if TYPE_CHECKING:
    from slipguard.sim.world import World

START_POSE = (-0.3, -0.2, 0.3, 0.0, math.pi, 0.0)
STEP_S = 0.001


class ToolPlant(Protocol):
    """A tool that can be moved and stopped. For an earlier time than the last, the present state is returned."""

    @abstractmethod
    def pose(self, now_s: float) -> Sequence[float]:
        """Return the pose: six numbers."""

    @abstractmethod
    def velocity(self, now_s: float) -> Sequence[float]:
        """Return the velocity: six numbers."""

    @abstractmethod
    def under_way(self, now_s: float) -> bool:
        """Return whether it moves or is about to move."""

    @abstractmethod
    def move(self, now_s: float, goal: Sequence[float], speed_m_s: float, acceleration_m_s2: float) -> None:
        """Start a straight move to a pose; replaces the current one."""

    @abstractmethod
    def stop(self, now_s: float, deceleration_m_s2: float) -> None:
        """Brake to rest."""


class StraightTool(ToolPlant):
    """A point that moves on straight lines, in steps of a millisecond, with constant orientation."""

    def __init__(self) -> None:
        self._pose = list(START_POSE)
        self._goal: list[float] | None = None
        self._direction = [0.0, 0.0, 0.0]
        self._speed_m_s = 0.0
        self._limit_m_s = 0.0
        self._acceleration = 1.0
        self._now_s: float | None = None

    def pose(self, now_s: float) -> Sequence[float]:
        self._advance(now_s)
        return tuple(self._pose)

    def velocity(self, now_s: float) -> Sequence[float]:
        self._advance(now_s)
        x, y, z = (self._speed_m_s * part for part in self._direction)
        return (x, y, z, 0.0, 0.0, 0.0)

    def under_way(self, now_s: float) -> bool:
        self._advance(now_s)
        return self._goal is not None or self._speed_m_s > 0.0

    def move(self, now_s: float, goal: Sequence[float], speed_m_s: float, acceleration_m_s2: float) -> None:
        self._advance(now_s)
        self._goal, self._limit_m_s, self._acceleration = list(goal), speed_m_s, acceleration_m_s2

    def stop(self, now_s: float, deceleration_m_s2: float) -> None:
        self._advance(now_s)
        self._goal, self._acceleration = None, deceleration_m_s2

    def _advance(self, now_s: float) -> None:
        if self._now_s is None or (self._goal is None and self._speed_m_s == 0.0):
            self._now_s = now_s
        while now_s - self._now_s >= STEP_S:
            self._now_s += STEP_S
            self._step()

    def _step(self) -> None:
        change = self._acceleration * STEP_S
        if self._goal is None:
            self._speed_m_s = max(0.0, self._speed_m_s - change)
        else:
            way = [goal - here for goal, here in zip(self._goal[:3], self._pose[:3], strict=True)]
            left_m = math.hypot(*way)
            braking_m_s = math.sqrt(2 * self._acceleration * left_m)
            self._speed_m_s = min(self._limit_m_s, self._speed_m_s + change, braking_m_s)
            if left_m <= max(self._speed_m_s * STEP_S, 1e-6):
                self._pose, self._speed_m_s, self._goal = list(self._goal), 0.0, None
                return
            self._direction = [part / left_m for part in way]
        for axis, part in enumerate(self._direction):
            self._pose[axis] += part * self._speed_m_s * STEP_S


class WorldTool(ToolPlant):
    """The arm of a simulated world. It moves vertically only: of a goal, the height counts.

    base_z_m: z of the world's height 0 in the base frame.
    """

    def __init__(self, world: World, base_z_m: float = START_POSE[2]) -> None:
        self._world = world
        self._base_z_m = base_z_m

    def pose(self, now_s: float) -> Sequence[float]:
        height_m = self._world.arm_state(now_s).height_mm / 1000.0
        return (*START_POSE[:2], self._base_z_m + height_m, *START_POSE[3:])

    def velocity(self, now_s: float) -> Sequence[float]:
        return (0.0, 0.0, self._world.arm_state(now_s).speed_mm_s / 1000.0, 0.0, 0.0, 0.0)

    def under_way(self, now_s: float) -> bool:
        return self._world.arm_state(now_s).moving

    def move(self, now_s: float, goal: Sequence[float], speed_m_s: float, acceleration_m_s2: float) -> None:
        way_mm = (goal[2] - self.pose(now_s)[2]) * 1000.0
        self._world.command_lift(now_s, way_mm, speed_m_s * 1000.0)

    def stop(self, now_s: float, deceleration_m_s2: float) -> None:
        self._world.command_stop(now_s)
