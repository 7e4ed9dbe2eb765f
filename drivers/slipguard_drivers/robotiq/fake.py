"""The gripper of the simulated world: one call at a time, each a round trip on the wire.

It fails on demand (`world.faults`): "disconnect", "timeout" (no answer), "fault" (answers, but
moves nothing), "late" (answers take their time), "wrong_echo" (does what it is told, answers something else).
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated, TypeVar

from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import DriverContext, Gripper, GripperState
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.robotiq.registers import MODEL_2F85, force_to_count, width_to_count

if TYPE_CHECKING:
    from slipguard.sim.world import World

T = TypeVar("T")
LATE_S = 0.2


class FakeGripper(Gripper):
    """A 2F-85 whose fingers are the shared world's."""

    class Settings(BaseModel):
        """round_trip_ms: request and answer at 115200 Bd, adapter with a latency timer of 1 ms."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        round_trip_ms: Annotated[float, Field(ge=0.0, le=100.0)] = 4.0
        timeout_ms: Annotated[float, Field(ge=5.0, le=1000.0)] = 50.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:
        self._name = context.name
        self._world: World = context.require_world()
        self._settings = settings
        self._wire = asyncio.Lock()
        self._open = False
        self._goal_mm = MODEL_2F85.stroke_mm
        """Where the fingers were last told to go."""

    @property
    def force_limits_n(self) -> tuple[float, float]:
        """Those of a 2F-85."""
        return MODEL_2F85.force_min_n, MODEL_2F85.force_max_n

    async def open(self) -> None:
        """Connect; the fingers stay as they are."""
        if "disconnect" in self._faults():
            self._open = False
            raise DeviceLost(f"{self._name}: no gripper answers; check its cable and power")
        self._open = True

    async def state(self) -> GripperState:
        """Ask the gripper now."""
        return await self._round_trip(self._state)

    async def hold(self, force_n: float) -> float:
        """Close on what is there with `force_n`; return the force applied."""
        force_to_count(force_n, MODEL_2F85)  # refuses what is no force

        def order(now_s: float) -> float:
            self._check_fault()
            self._goal_mm = 0.0
            return self._world.command_hold(now_s, force_n)

        return await self._round_trip(order, trips=2)  # stop, then go: the force register acts in motion only

    async def move(self, width_mm: float, force_n: float) -> float:
        """Move empty-handed; return the width commanded."""
        width_to_count(width_mm, MODEL_2F85)
        force_to_count(force_n, MODEL_2F85)  # refuses what is no force

        def order(now_s: float) -> float:
            self._check_fault()
            state = self._state(now_s)
            if state.holding:
                raise CommandRefused(
                    f"{self._name}: an object is held and a move would let it go; use release for that"
                )
            if state.moving and self._goal_mm < state.width_mm and width_mm > self._goal_mm:
                raise CommandRefused(
                    f"{self._name}: the fingers are closing and may have met something; ask again when they are at rest"
                )
            self._goal_mm = width_mm
            return self._world.command_move(now_s, width_mm, force_n)

        return await self._round_trip(order)

    async def halt(self) -> None:
        """Stop the fingers where they are."""
        await self._round_trip(self._world.command_halt)

    async def release(self, width_mm: float) -> None:
        """Open to `width_mm`."""
        width_to_count(width_mm, MODEL_2F85)

        def order(now_s: float) -> None:
            self._check_fault()
            self._goal_mm = width_mm
            self._world.command_release(now_s, width_mm)

        await self._round_trip(order)

    async def close(self) -> None:
        """Disconnect; the grip stays."""
        self._open = False

    def _faults(self) -> frozenset[str]:
        return self._world.faults.active(self._name)

    def _state(self, now_s: float) -> GripperState:
        return self._world.gripper_state(now_s)

    def _check_fault(self) -> None:
        if "fault" in self._faults():
            raise DeviceError(f"{self._name}: the gripper reports a fault (internal fault) and moves nothing")

    async def _round_trip(self, act: Callable[[float], T], trips: int = 1) -> T:
        """Have the wire to oneself; `act(now_s)` is what the gripper does when the request arrives."""
        async with self._wire:
            self._check_connection()
            if "timeout" in self._faults():
                await asyncio.sleep(self._settings.timeout_ms / 1000.0)
                raise DeviceTimeout(f"{self._name}: no answer within {self._settings.timeout_ms:.0f} ms")
            answer = act(asyncio.get_running_loop().time())
            late_s = LATE_S if "late" in self._faults() else 0.0
            await asyncio.sleep(trips * self._settings.round_trip_ms / 1000.0 + late_s)
            self._check_connection()
            if "wrong_echo" in self._faults():
                raise DeviceTimeout(f"{self._name}: an answer to something else than was asked; asking again")
            return answer

    def _check_connection(self) -> None:
        if not self._open:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")
        if "disconnect" in self._faults():
            self._open = False
            raise DeviceLost(f"{self._name}: the connection is gone; open it again")
