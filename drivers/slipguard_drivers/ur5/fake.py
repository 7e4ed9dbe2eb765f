"""Driver `fake` of the arm: the simulated world's arm, which moves vertically, stops, and reports safety stops.

`world.faults` can make it fail: "disconnect", "timeout" (no state, no response), "protective_stop", "emergency_stop",
"stuck" (accepts commands, but does not move).
"""

from __future__ import annotations

import asyncio
import contextlib
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.ur5.preconditions import check_lift

if TYPE_CHECKING:
    from slipguard.sim.world import World


class FakeArmSettings(BaseModel):
    """period_ms: time between states (125 Hz, as from a CB3 controller)."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    period_ms: Annotated[float, Field(ge=0.0, le=100.0)] = 8.0
    timeout_ms: Annotated[float, Field(ge=10.0, le=5000.0)] = 100.0


class FakeArm(Arm):
    """The simulated world's arm."""

    Settings = FakeArmSettings

    def __init__(self, settings: FakeArmSettings, context: DriverContext) -> None:
        self._name = context.name
        self._world: World = context.require_world()
        self._guard_mode = context.mode == "guard"
        self._settings = settings
        self._lock = asyncio.Lock()
        self._zero_height_mm: float | None = None

    async def open(self) -> None:
        """Connect without moving; heights are relative to the present position. Idempotent."""
        if "disconnect" in self._faults():
            self._zero_height_mm = None
            raise DeviceLost(f"{self._name}: no arm answers; check its power and network cable")
        if self._zero_height_mm is None:
            self._zero_height_mm = self._world.arm_state(asyncio.get_running_loop().time()).height_mm

    async def state(self) -> ArmState:
        """Return the state of the arm's next cycle."""
        async with self._lock:
            return self._state(await self._next_cycle())

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start moving by `height_mm`; return the speed applied."""
        if self._guard_mode:
            self._check_connection()
            raise CommandRefused(f"{self._name}: in guard mode another program moves the arm; lift with that program")
        check_lift(self._name, height_mm, speed_mm_s)
        async with self._lock:
            now_s = await self._next_cycle()
            state = self._state(now_s)
            if state.emergency_stop or state.protective_stop:
                kind = "an emergency" if state.emergency_stop else "a protective"
                raise CommandRefused(f"{self._name}: {kind} stop is active; clear it at the controller first")
            if "stuck" in self._faults():
                return speed_mm_s
            return self._world.command_lift(now_s, height_mm, speed_mm_s)

    async def stop(self) -> None:
        """Stop now. A safety stop has the same effect, so it is no error here."""
        async with self._lock:
            self._world.command_stop(await self._next_cycle())

    async def close(self) -> None:
        """Stop and disconnect; in guard mode a motion continues."""
        if self._zero_height_mm is not None and not self._guard_mode:
            with contextlib.suppress(DeviceError):
                await self.stop()
        self._zero_height_mm = None

    def _faults(self) -> frozenset[str]:
        return self._world.faults.active(self._name)

    def _state(self, now_s: float) -> ArmState:
        state = self._world.arm_state(now_s)
        if state.moving and "stuck" in self._faults():
            self._world.command_stop(now_s)
        assert self._zero_height_mm is not None
        return replace(state, height_mm=state.height_mm - self._zero_height_mm)

    async def _next_cycle(self) -> float:
        """Wait for the arm's next cycle; return its time."""
        self._check_connection()
        if "timeout" in self._faults():
            await asyncio.sleep(self._settings.timeout_ms / 1000.0)
            raise DeviceTimeout(f"{self._name}: no state for {self._settings.timeout_ms:.0f} ms; check its cable")
        await asyncio.sleep(self._settings.period_ms / 1000.0 / 2)
        self._check_connection()
        return asyncio.get_running_loop().time()

    def _check_connection(self) -> None:
        if self._zero_height_mm is None:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")
        if "disconnect" in self._faults():
            self._zero_height_mm = None
            raise DeviceLost(f"{self._name}: the connection is gone; open it again")
