"""A UR5: moved by slipguard in lift mode, only watched and paused in guard mode."""

from __future__ import annotations

from collections.abc import AsyncIterator

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.diagnosis import CheckResult
from slipguard_drivers.ur5.diagnostics import check_controller
from slipguard_drivers.ur5.guard_mode import GuardModeArm
from slipguard_drivers.ur5.lift_mode import LiftModeArm
from slipguard_drivers.ur5.settings import Ur5Settings


class Ur5Arm(Arm):
    """The way that fits the mode. Which one is settled when it is built."""

    Settings = Ur5Settings

    def __init__(self, settings: Ur5Settings, context: DriverContext) -> None:
        self._name, self._settings, self._mode = context.name, settings, context.mode
        way = LiftModeArm if context.mode == "lift" else GuardModeArm
        self._way: LiftModeArm | GuardModeArm = way(context.name, settings)

    async def open(self) -> None:
        await self._way.open()

    async def state(self) -> ArmState:
        return await self._way.state()

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        return await self._way.lift(height_mm, speed_mm_s)

    async def stop(self) -> None:
        await self._way.stop()

    async def close(self) -> None:
        await self._way.close()

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """For the doctor: nothing is taken over, so it may look whoever has the arm."""
        async for result in check_controller(self._name, self._settings, self._mode, owned=owned):
            yield result
