"""Driver `ur5`: a UR arm that slipguard moves in lift mode, and only monitors and pauses in guard mode."""

from __future__ import annotations

import contextlib
import importlib.util
import platform
from collections.abc import AsyncIterator

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.diagnosis import CheckResult
from slipguard.errors import ConfigError
from slipguard_drivers.ur5.diagnostics import check_controller
from slipguard_drivers.ur5.guard_mode import GuardModeArm
from slipguard_drivers.ur5.lift_mode import LiftModeArm
from slipguard_drivers.ur5.settings import Ur5Settings


class Ur5Arm(Arm):
    """Delegate to the arm of the configured mode; the mode does not change afterwards."""

    Settings = Ur5Settings

    def __init__(self, settings: Ur5Settings, context: DriverContext) -> None:
        """Raises ConfigError in lift mode if ur-rtde is not installed."""
        self._name, self._settings, self._mode = context.name, settings, context.mode
        self._arm: LiftModeArm | GuardModeArm
        if context.mode == "lift":
            require_ur_rtde(context.name)
            self._arm = LiftModeArm(context.name, settings)
        else:
            self._arm = GuardModeArm(context.name, settings)

    async def open(self) -> None:
        await self._arm.open()

    async def state(self) -> ArmState:
        return await self._arm.state()

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        return await self._arm.lift(height_mm, speed_mm_s)

    async def stop(self) -> None:
        await self._arm.stop()

    async def close(self) -> None:
        await self._arm.close()

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """Check the controller for `slipguard doctor`; it takes nothing over, so other programs may run."""
        async for result in check_controller(self._name, self._settings, self._mode, owned=owned):
            yield result


def require_ur_rtde(name: str) -> None:
    """Raise ConfigError if ur-rtde, which moves the arm in lift mode, is not installed."""
    with contextlib.suppress(ImportError):
        if importlib.util.find_spec("rtde_control") is not None:
            return
    raise ConfigError(
        f"{name}: ur-rtde is not installed, and mode 'lift' needs it to move the arm (this is Python "
        f"{platform.python_version()}; ur-rtde has wheels for Python 3.11 and 3.12). Install slipguard with "
        'Python 3.11 or 3.12, or set [guard] mode = "guard", which works without ur-rtde'
    )
