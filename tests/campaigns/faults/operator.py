"""The person at the cell: grasps, lifts, holds, puts down, lets go; clears what can be cleared. Never in a hurry."""

from __future__ import annotations

import asyncio

from slipguard.control.state import Phase
from slipguard.daemon.api.requests import (
    ClearRequest,
    DaemonRequest,
    GraspRequest,
    LiftRequest,
    LowerRequest,
    ReleaseRequest,
)
from slipguard.errors import CommandRefused
from tests.campaigns.faults.rig import CampaignCell

LOOKS_S = 0.1
CLEARS_S = 0.6
PUTS_DOWN_AFTER_S = 10.5


class Operator:
    """asked: the jaws have been asked to open."""

    def __init__(self, rig: CampaignCell, began_s: float) -> None:
        self.asked = False
        self._rig, self._began_s = rig, began_s
        self._grasped = self._lifted = self._lowered = False
        self._tried_s = 0.0

    async def work(self) -> None:
        """Until cancelled."""
        while True:
            await asyncio.sleep(LOOKS_S)
            if self._rig.alive and not self.asked:
                await self._look()

    async def _look(self) -> None:
        rig, phase = self._rig, self._rig.service.phase
        if phase is Phase.FAULT and rig.now_s - self._tried_s >= CLEARS_S:
            self._tried_s = rig.now_s
            await self._granted(ClearRequest())
        elif phase is Phase.IDLE and not self._grasped:
            self._grasped = await self._granted(GraspRequest())
        elif phase is Phase.HOLDING and rig.service.firm:
            await self._go_on()

    async def _go_on(self) -> None:
        """Up, wait, down, open."""
        if not self._lifted:
            self._lifted = await self._granted(LiftRequest())
        elif self._rig.now_s - self._began_s < PUTS_DOWN_AFTER_S:
            return
        elif not self._lowered:
            self._lowered = await self._granted(LowerRequest(height_mm=max(self._rig.truth.height_mm, 1.0)))
        else:
            self.asked = True
            await self._granted(ReleaseRequest(confirm=True))

    async def _granted(self, request: DaemonRequest) -> bool:
        try:
            await self._rig.handlers.submit(request)
        except CommandRefused:
            return False
        return True
