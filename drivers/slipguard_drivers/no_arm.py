"""Driver `none` of the arm: a cell without an arm that slipguard could stop. The grip is guarded, nothing else."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator

from pydantic import BaseModel, ConfigDict

from slipguard.devices import Arm, ArmState, DriverContext
from slipguard.diagnosis import CheckResult, ok
from slipguard.errors import CommandRefused, ConfigError


class NoArmSettings(BaseModel):
    """There is nothing to set."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class NoArm(Arm):
    """Stands in for an arm that nothing is known about. A slip is met by the grip alone."""

    Settings = NoArmSettings

    def __init__(self, settings: NoArmSettings, context: DriverContext) -> None:
        """Raises ConfigError in lift mode, in which slipguard moves the arm."""
        self._name = context.name
        if context.mode == "lift":
            raise ConfigError(
                f'{context.name}: driver = "none" and [guard] mode = "lift": without an arm slipguard cannot lift; '
                'set mode = "guard", or name the arm\'s driver'
            )

    async def open(self) -> None:
        """Do nothing."""

    async def state(self) -> ArmState:
        """Return a state of rest, of which slipguard does not know whether it is true."""
        now_s = asyncio.get_running_loop().time()
        return ArmState(0.0, 0.0, False, False, False, now_s, motion_known=False)

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        """Refuse."""
        raise CommandRefused(f'{self._name}: there is no arm ([arm] driver = "none")')

    async def stop(self) -> None:
        """Do nothing: no arm is known that could be stopped."""

    async def close(self) -> None:
        """Do nothing."""

    async def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """Report for `slipguard doctor` that there is no arm to check."""
        yield ok("arm", 'none ([arm] driver = "none"): only the grip is guarded, and no arm is stopped when it slips')
