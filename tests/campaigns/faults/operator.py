"""A simulated operator: grasps, lifts, holds, lowers and releases, and clears faults."""

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
from tests.campaigns.faults.campaign_cell import CampaignCell

POLL_S = 0.1
CLEAR_S = 0.6
LOWER_AFTER_S = 10.5


class Operator:
    """Operates one cell. release_requested: the operator has requested the jaws to open."""

    def __init__(self, cell: CampaignCell, began_s: float) -> None:
        self.release_requested = False
        self._cell, self._began_s = cell, began_s
        self._grasped = self._lifted = self._lowered = False
        self._cleared_s = 0.0

    async def work(self) -> None:
        """Work until cancelled."""
        while True:
            await asyncio.sleep(POLL_S)
            if self._cell.alive and not self.release_requested:
                await self._act()

    async def _act(self) -> None:
        cell, phase = self._cell, self._cell.service.phase
        if phase is Phase.FAULT and cell.now_s - self._cleared_s >= CLEAR_S:
            self._cleared_s = cell.now_s
            await self._accepted(ClearRequest())
        elif phase is Phase.IDLE and not self._grasped:
            self._grasped = await self._accepted(GraspRequest())
        elif phase is Phase.HOLDING and cell.service.ready_to_lift:
            await self._proceed()

    async def _proceed(self) -> None:
        """Lift, wait, lower, release."""
        if not self._lifted:
            self._lifted = await self._accepted(LiftRequest())
        elif self._cell.now_s - self._began_s < LOWER_AFTER_S:
            return
        elif not self._lowered:
            self._lowered = await self._accepted(LowerRequest(height_mm=max(self._cell.truth.height_mm, 1.0)))
        else:
            self.release_requested = True
            await self._accepted(ReleaseRequest(confirm=True))

    async def _accepted(self, request: DaemonRequest) -> bool:
        try:
            await self._cell.submit(request)
        except CommandRefused:
            return False
        return True
