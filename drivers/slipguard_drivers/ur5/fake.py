"""The arm of the simulated world: moves along the vertical, stops, and reports its safety stops.

It fails on demand (`world.faults`): "disconnect", "timeout" (no state, no answer),
"protective_stop", "emergency_stop", "stuck" (hears, but does not move).
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout

if TYPE_CHECKING:
    from slipguard.sim.world import World


class FakeArm(Arm):
    """The shared world's arm."""

    class Settings(BaseModel):
        """period_ms: a state comes this often (125 Hz, as from a CB3 controller)."""

        model_config = ConfigDict(frozen=True, extra="forbid")

        period_ms: Annotated[float, Field(ge=0.0, le=100.0)] = 8.0
        timeout_ms: Annotated[float, Field(ge=10.0, le=5000.0)] = 100.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:
        self._name = context.name
        self._world: World = context.require_world()
        self._guarded = context.mode == "guard"
        self._settings = settings
        self._call = asyncio.Lock()
        self._found_at_mm: float | None = None

    async def open(self) -> None:
        """Connect without moving; heights count from here. Idempotent."""
        if "disconnect" in self._faults():
            self._found_at_mm = None
            raise DeviceLost(f"{self._name}: no arm answers; check its power and network cable")
        if self._found_at_mm is None:
            self._found_at_mm = self._world.arm_state(asyncio.get_running_loop().time()).height_mm

    async def state(self) -> ArmState:
        """The state the arm sends next."""
        async with self._call:
            return self._state(await self._answer())

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start moving by `height_mm`; return the speed applied."""
        if self._guarded:
            self._check_connection()
            raise CommandRefused(f"{self._name}: in guard mode another program moves the arm; lift and lower with that")
        if not math.isfinite(height_mm):
            raise CommandRefused(f"{self._name}: height_mm is {height_mm}; it must be a number")
        if not (math.isfinite(speed_mm_s) and speed_mm_s > 0):
            raise CommandRefused(f"{self._name}: speed_mm_s is {speed_mm_s}; it must be above 0")
        async with self._call:
            now_s = await self._answer()
            state = self._state(now_s)
            if state.emergency_stop or state.protective_stop:
                which = "an emergency" if state.emergency_stop else "a protective"
                raise CommandRefused(f"{self._name}: {which} stop is active; clear it at the controller first")
            if "stuck" in self._faults():
                return speed_mm_s
            return self._world.command_lift(now_s, height_mm, speed_mm_s)

    async def stop(self) -> None:
        """Stop now. A stop from the safety system has the same effect, so it is no error here."""
        async with self._call:
            self._world.command_stop(await self._answer())

    async def close(self) -> None:
        """Stop and disconnect; in guard mode whatever moves goes on."""
        if self._found_at_mm is not None and not self._guarded:
            with contextlib.suppress(DeviceError):
                await self.stop()
        self._found_at_mm = None

    def _faults(self) -> frozenset[str]:
        return self._world.faults.active(self._name)

    def _state(self, now_s: float) -> ArmState:
        state = self._world.arm_state(now_s)
        if state.moving and "stuck" in self._faults():
            self._world.command_stop(now_s)
        assert self._found_at_mm is not None
        return replace(state, height_mm=state.height_mm - self._found_at_mm)

    async def _answer(self) -> float:
        """Wait for the arm's next cycle; return its time."""
        self._check_connection()
        if "timeout" in self._faults():
            await asyncio.sleep(self._settings.timeout_ms / 1000.0)
            raise DeviceTimeout(f"{self._name}: no state for {self._settings.timeout_ms:.0f} ms")
        await asyncio.sleep(self._settings.period_ms / 1000.0 / 2)
        self._check_connection()
        return asyncio.get_running_loop().time()

    def _check_connection(self) -> None:
        if self._found_at_mm is None:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")
        if "disconnect" in self._faults():
            self._found_at_mm = None
            raise DeviceLost(f"{self._name}: the connection is gone; open it again")
