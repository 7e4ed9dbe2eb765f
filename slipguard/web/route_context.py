"""What the routes share: the door to the daemon, the live stream, the pictures, and who has access."""

from __future__ import annotations

from slipguard.daemon.api.daemon_api import DaemonApi
from slipguard.web.access import Access
from slipguard.web.images import FingerImages
from slipguard.web.live import PERIOD_S, LiveStream
from slipguard.web.ttl_cache import TtlCache

STORED_S = 1.0
"""What is stored changes by a command only, or by somebody's hand."""


class RouteContext:
    """access: None where no TCP port is listened at."""

    def __init__(self, control: DaemonApi, access: Access | None = None) -> None:
        self.control = control
        self.access = access
        self.state = TtlCache(control.state, PERIOD_S)
        self.trouble = TtlCache(control.trouble, PERIOD_S)
        self.tallies = TtlCache(control.tallies, PERIOD_S)
        self.no_contacts = TtlCache(control.no_contacts, STORED_S)
        self.pictures = FingerImages(control)
        self.live = LiveStream(self.state.get)

    def forget(self) -> None:
        """What is asked for next is as it is from now on: something was changed."""
        for shared in (self.state, self.trouble, self.no_contacts):
            shared.forget()

    async def run(self) -> None:
        """Keep the live stream going until cancelled."""
        deafen = self.control.listen(self.live.hear)
        try:
            await self.live.run()
        finally:
            deafen()
