"""What the routes share: the door to the daemon, the live stream, the pictures, and who has access."""

from __future__ import annotations

from slipguard.daemon.control import Control
from slipguard.web.access import Access
from slipguard.web.live import PERIOD_S, Live
from slipguard.web.pictures import Pictures
from slipguard.web.shared import Shared


class Room:
    """access: None where no TCP port is listened at."""

    def __init__(self, control: Control, access: Access | None = None) -> None:
        self.control = control
        self.access = access
        self.state = Shared(control.state, PERIOD_S)
        self.tallies = Shared(control.tallies, PERIOD_S)
        self.pictures = Pictures(control)
        self.live = Live(self.state.get)

    async def run(self) -> None:
        """Keep the live stream going until cancelled."""
        deafen = self.control.listen(self.live.hear)
        try:
            await self.live.run()
        finally:
            deafen()
