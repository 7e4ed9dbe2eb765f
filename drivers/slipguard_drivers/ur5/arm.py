"""A UR5 through ur-rtde: vertical moves only, a heartbeat that stops the arm when the loop stops.

While the arm is open, a task of this loop asks the worker for a `beat` twenty times a second. It brings the state, and
it feeds the watchdog in the robot: a daemon that hangs or dies stops the arm within the watchdog's time.
"""

from __future__ import annotations

import asyncio
import contextlib
import math
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.errors import CommandRefused, DeviceError, DeviceLost, DeviceTimeout
from slipguard_drivers.ur5.link import WorkerLink

BEAT_S = 0.05
STALE_S = 0.2
"""A state older than this is no state: four beats, or 25 packets of a CB3 controller."""
GIVE_UP_S = 1.0
"""The controller's clock standing still for this long: the worker is killed and the arm must be opened again."""
CALL_S = 1.0
MOVING_MM_S = 0.5


class Ur5Arm(Arm):
    """One arm, its base upright: up is the base's z axis."""

    class Settings(BaseModel):
        """host: the controller's address. watchdog_hz: the robot stops when it hears nothing for 1 / watchdog_hz."""

        model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

        host: str
        speed_max_mm_s: Annotated[float, Field(gt=0.0, le=250.0)] = 250.0
        acceleration_mm_s2: Annotated[float, Field(ge=50.0, le=2500.0)] = 500.0
        stop_mm_s2: Annotated[float, Field(ge=500.0, le=10000.0)] = 2500.0
        watchdog_hz: Annotated[float, Field(ge=2.0, le=15.0)] = 4.0

    def __init__(self, settings: Settings, context: DriverContext) -> None:
        self._name = context.name
        self._settings = settings
        self._link = WorkerLink(context.name, settings.host)
        self._heart: asyncio.Task[None] | None = None
        self._lost: str | None = None
        self._newest: dict[str, Any] = {}
        self._advanced_at_s = 0.0
        self._found_at_m = 0.0

    async def open(self) -> None:
        """Connect without moving; heights count from here. Idempotent."""
        if self._heart is not None and not self._heart.done():
            return
        await self._stop_heart()
        stop_m_s2 = self._settings.stop_mm_s2 / 1000.0
        await self._link.start(self._settings.watchdog_hz, stop_m_s2)
        self._lost = None
        self._newest = {}
        try:
            await self._beat()
        except BaseException:
            self._link.kill()
            raise
        self._found_at_m = self._newest["height_m"]
        self._heart = asyncio.create_task(self._keep_beating(), name=f"{self._name}: heartbeat")

    async def state(self) -> ArmState:
        """What the last beat brought. Raises DeviceTimeout when it is old, DeviceLost when the worker is gone."""
        self._check_alive()
        age_s = asyncio.get_running_loop().time() - self._advanced_at_s
        if age_s > STALE_S:
            raise DeviceTimeout(f"{self._name}: no new state from the controller for {age_s * 1000:.0f} ms")
        newest = self._newest
        speed_mm_s = newest["speed_m_s"] * 1000.0
        return ArmState(
            height_mm=(newest["height_m"] - self._found_at_m) * 1000.0,
            speed_mm_s=speed_mm_s,
            moving=newest["travelling"] or abs(speed_mm_s) > MOVING_MM_S,
            protective_stop=newest["protective"],
            emergency_stop=newest["emergency"],
            measured_at_s=self._advanced_at_s,
        )

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Start moving; return the speed applied, at most the configured one."""
        if not math.isfinite(height_mm):
            raise CommandRefused(f"{self._name}: height_mm is {height_mm}; it must be a number")
        if not (math.isfinite(speed_mm_s) and speed_mm_s > 0):
            raise CommandRefused(f"{self._name}: speed_mm_s is {speed_mm_s}; it must be above 0")
        state = await self.state()
        if state.emergency_stop or state.protective_stop:
            which = "an emergency" if state.emergency_stop else "a protective"
            raise CommandRefused(f"{self._name}: {which} stop is active; clear it at the controller first")
        speed_mm_s = min(speed_mm_s, self._settings.speed_max_mm_s)
        acceleration = self._settings.acceleration_mm_s2
        await self._link.call("lift", height_mm / 1000, speed_mm_s / 1000, acceleration / 1000, deadline_s=CALL_S)
        return speed_mm_s

    async def stop(self) -> None:
        """Stop now. A worker that does not answer is killed, and the robot's watchdog stops the arm."""
        self._check_alive()
        await self._link.call("stop", self._settings.stop_mm_s2 / 1000, deadline_s=CALL_S)

    async def close(self) -> None:
        """Stop the arm, end our script on the controller, disconnect."""
        await self._stop_heart()
        if self._link.up:
            with contextlib.suppress(DeviceError, CommandRefused):
                await self._link.call("stop", self._settings.stop_mm_s2 / 1000, deadline_s=CALL_S)
                await self._link.call("leave", deadline_s=CALL_S)
        self._link.kill()

    def _check_alive(self) -> None:
        if self._lost is not None:
            raise DeviceLost(self._lost)
        if self._heart is None:
            raise DeviceLost(f"{self._name}: the connection is not open; open it first")

    async def _beat(self) -> None:
        newest = await self._link.call("beat", deadline_s=CALL_S)
        now_s = asyncio.get_running_loop().time()
        if newest["timestamp_s"] != self._newest.get("timestamp_s"):
            self._advanced_at_s = now_s
        elif now_s - self._advanced_at_s > GIVE_UP_S:
            raise DeviceLost(f"{self._name}: the controller's clock has stood still for {GIVE_UP_S:g} s")
        if not newest["running"] and not (newest["protective"] or newest["emergency"]):
            raise DeviceLost(f"{self._name}: our script on the controller has ended; open the arm again")
        self._newest = newest

    async def _keep_beating(self) -> None:
        loop = asyncio.get_running_loop()
        due_s = loop.time()
        try:
            while True:
                due_s = max(due_s + BEAT_S, loop.time())
                await asyncio.sleep(due_s - loop.time())
                await self._beat()
        except DeviceError as error:
            self._lost = str(error)
            self._link.kill()

    async def _stop_heart(self) -> None:
        if self._heart is not None:
            self._heart.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._heart
            self._heart = None
