"""The jaws of the simulated world behind the emulated gripper's registers."""

from __future__ import annotations

from slipguard.sim.world import World
from slipguard_emulators.robotiq.jaws import JawsPlant, JawsState

CLOSED_MM = 0.2
"""A goal below this is the closed position: half a count."""


class WorldJaws(JawsPlant):
    """The world's gripper. It moves at the world's own speed and ignores the requested one."""

    def __init__(self, world: World) -> None:
        self._world = world

    def drive(self, now_s: float, width_mm: float, speed_mm_s: float, force_n: float) -> None:
        """See `JawsPlant`."""
        if width_mm > self._world.gripper_state(now_s).width_mm:
            self._world.command_release(now_s, width_mm)
        elif width_mm < CLOSED_MM:
            self._world.command_hold(now_s, force_n)
        else:
            self._world.command_move(now_s, width_mm, force_n)

    def halt(self, now_s: float) -> None:
        """See `JawsPlant`."""
        self._world.command_halt(now_s)

    def state_at(self, now_s: float) -> JawsState:
        """See `JawsPlant`."""
        state, truth = self._world.gripper_state(now_s), self._world.truth(now_s)
        return JawsState(
            width_mm=state.width_mm,
            force_n=truth.force_n,
            moving=state.moving,
            met_closing=state.holding and not state.moving,
        )
