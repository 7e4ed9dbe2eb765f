"""Driver `fake` of the gripper: the simulated world's gripper. Each call is a round trip on a wire.

`world.faults` can make it fail: "disconnect", "timeout" (no response), "fault" (responds, but does not move), "late"
(slow responses), "wrong_echo" (executes the command, but responds to another one).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import ACTIVATION_HINT, DriverContext, Gripper, GripperState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq.registers import (
    GEL_GAP_MM,
    MODEL_2F85,
    force_to_count,
    nothing_between,
    width_to_count,
)

if TYPE_CHECKING:
    from slipguard.sim.world import World

T = TypeVar("T")
LATE_S = 0.2
ACTIVATION_POLL_S = 0.05
RELEASE_MIN_MM = 5.6
"""A release opens at least this far, as a 2F-85's does."""


class FakeGripperSettings(BaseModel):
    """round_trip_ms: request and response at 115200 Bd, with an adapter whose latency timer is 1 ms.

    fingertip_mm: as of the driver `robotiq`; the world's sensors may be thicker or thinner than that.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    round_trip_ms: Annotated[float, Field(ge=0.0, le=100.0)] = 4.0
    timeout_ms: Annotated[float, Field(ge=5.0, le=1000.0)] = 50.0
    fingertip_mm: Annotated[float, Field(ge=0.0, le=40.0)] = 0.0


class FakeGripper(Gripper):
    """A 2F-85 whose fingers are in the simulated world."""

    Settings = FakeGripperSettings

    def __init__(self, settings: FakeGripperSettings, context: DriverContext) -> None:
        self._name = context.name
        self._world: World = context.require_world()
        self._settings = settings
        self._wire = asyncio.Lock()
        self._open = False
        self._force_known = False
        """Whether the grip was commanded on this connection."""
        self._auto_released = False
        """Whether an automatic release was commanded since the last activation."""
        self._fingers_mm = 2.0 * settings.fingertip_mm
        """Width of the fingers without sensors where the gels touch."""
        self._closed_mm = GEL_GAP_MM if settings.fingertip_mm else 0.0
        """Width between the gels at which closing ends."""
        self._goal_mm = MODEL_2F85.stroke_mm - self._fingers_mm
        """The last commanded width between the gels."""

    @property
    def force_limits_n(self) -> tuple[float, float]:
        """Return the force range of a 2F-85."""
        return MODEL_2F85.force_min_n, MODEL_2F85.force_max_n

    async def open(self) -> None:
        """Connect; the fingers do not move."""
        if "disconnect" in self._faults():
            self._open = False
            raise DeviceLost(f"{self._name}: no gripper answers; check its cable and power")
        self._force_known = self._force_known and self._open
        self._open = True

    async def state(self) -> GripperState:
        """Read the state now."""
        state = await self._round_trip(self._state)
        if self._force_known or not state.holding:
            return state
        return replace(state, force_n=min(state.force_n, MODEL_2F85.force_min_n), force_known=False)

    async def hold(self, force_n: float) -> float:
        """Close or tighten with `force_n`; return the force applied."""
        force_to_count(force_n, MODEL_2F85)  # refuses invalid forces

        def command(now_s: float) -> float:
            self._check_ready()
            self._goal_mm, self._force_known = self._closed_mm, True
            return self._world.command_hold(now_s, force_n, self._closed_mm + self._fingers_mm)

        return await self._round_trip(command, trips=2)  # stop, then go: the force register acts in motion only

    async def move(self, width_mm: float, force_n: float) -> float:
        """Move the fingers without an object; return the width commanded."""
        width_to_count(width_mm, MODEL_2F85)
        force_to_count(force_n, MODEL_2F85)

        def command(now_s: float) -> float:
            self._check_ready()
            state = self._state(now_s)
            if state.holding:
                raise CommandRefused(f"{self._name}: an object is held and would fall; support it, then use release")
            if state.moving and self._goal_mm < state.width_mm and width_mm > self._goal_mm:
                raise CommandRefused(
                    f"{self._name}: the fingers are closing and may hold an object; try again when they are at rest"
                )
            self._goal_mm, self._force_known = max(width_mm, self._closed_mm), True
            return self._world.command_move(now_s, self._goal_mm + self._fingers_mm, force_n) - self._fingers_mm

        return await self._round_trip(command)

    async def halt(self) -> None:
        """Stop the fingers where they are."""
        await self._round_trip(self._world.command_halt)

    async def release(self, width_mm: float) -> None:
        """Open to `width_mm`; fully, by an automatic release, if the gripper is not activated."""
        width_to_count(width_mm, MODEL_2F85)

        def command(now_s: float) -> None:
            self._auto_released = not self._world.gripper_activated
            widest_mm = MODEL_2F85.stroke_mm if self._auto_released else self._state(now_s).width_mm + RELEASE_MIN_MM
            self._open_to(now_s, max(width_mm, widest_mm))

        await self._round_trip(command)

    async def activate(self) -> None:
        """Open, close and open fully, as a Robotiq does at its activation."""
        if self._world.gripper_activated:
            raise CommandRefused(f"{self._name}: the gripper is already activated")
        stroke_mm, force_n = MODEL_2F85.stroke_mm, MODEL_2F85.force_min_n
        await self._move_fully(lambda now_s: self._open_to(now_s, stroke_mm))
        await self._move_fully(lambda now_s: self._world.command_move(now_s, 0.0, force_n))
        await self._move_fully(lambda now_s: self._open_to(now_s, stroke_mm))
        self._world.gripper_activated, self._auto_released = True, False

    async def close(self) -> None:
        """Disconnect; the grip stays."""
        self._open = False

    def _faults(self) -> frozenset[str]:
        return self._world.faults.active(self._name)

    def _state(self, now_s: float) -> GripperState:
        """Return the state as a driver reports it that knows the fingertips: gels that meet hold nothing."""
        state = self._world.gripper_state(now_s)
        width_mm = max(state.width_mm - self._fingers_mm, 0.0)
        state = replace(state, auto_released=self._auto_released and not state.moving)
        if not self._fingers_mm or not nothing_between(width_mm):
            return replace(state, width_mm=width_mm)
        return replace(state, width_mm=width_mm, holding=False, closed_on_nothing=state.active)

    def _open_to(self, now_s: float, width_mm: float) -> None:
        self._check_fault()
        self._goal_mm = width_mm
        self._world.command_release(now_s, width_mm + self._fingers_mm)

    async def _move_fully(self, command: Callable[[float], object]) -> None:
        await self._round_trip(command)
        moving = True
        while moving:
            await asyncio.sleep(ACTIVATION_POLL_S)
            moving = (await self.state()).moving

    def _check_ready(self) -> None:
        self._check_fault()
        if not self._world.gripper_activated:
            raise CommandRefused(f"{self._name}: the gripper is not activated; {ACTIVATION_HINT}")

    def _check_fault(self) -> None:
        if "fault" in self._faults():
            raise DeviceError(f"{self._name}: the gripper reports a fault (internal fault) and does not move")

    async def _round_trip(self, execute: Callable[[float], T], trips: int = 1) -> T:
        """Use the wire exclusively. `execute(now_s)` is what the gripper does when the request arrives."""
        async with self._wire:
            self._check_connection()
            if "timeout" in self._faults():
                await asyncio.sleep(self._settings.timeout_ms / 1000.0)
                raise DeviceTimeout(
                    f"{self._name}: no response within {self._settings.timeout_ms:.0f} ms; check its power and cable"
                )
            response = execute(asyncio.get_running_loop().time())
            late_s = LATE_S if "late" in self._faults() else 0.0
            await asyncio.sleep(trips * self._settings.round_trip_ms / 1000.0 + late_s)
            self._check_connection()
            if "wrong_echo" in self._faults():
                raise DeviceTimeout(f"{self._name}: a response to another request; check the cable")
            return response

    def _check_connection(self) -> None:
        if not self._open:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")
        if "disconnect" in self._faults():
            self._open = False
            raise DeviceLost(f"{self._name}: the connection is gone; open it again")
