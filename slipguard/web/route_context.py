"""What the routes share: the daemon's API, caches of its responses, the live stream, images, and access control."""

from __future__ import annotations

from functools import partial

from slipguard.daemon.api.daemon_api import DaemonApi
from slipguard.devices import FINGERS
from slipguard.web.access import Access
from slipguard.web.frame_broadcast import FrameBroadcast
from slipguard.web.images import FingerImages
from slipguard.web.live import PERIOD_S, LiveStream
from slipguard.web.streams import EstimateStream
from slipguard.web.ttl_cache import TtlCache

BACKGROUNDS_TTL_S = 1.0
"""Stored images change only by a request, or by hand in the state folder."""


class RouteContext:
    """access: None if there is no TCP port."""

    def __init__(self, daemon: DaemonApi, access: Access | None = None) -> None:
        self.daemon = daemon
        self.access = access
        self.state = TtlCache(daemon.state, PERIOD_S)
        self.health_problem = TtlCache(daemon.health_problem, PERIOD_S)
        self.counters = TtlCache(daemon.counters, PERIOD_S)
        self.backgrounds = TtlCache(daemon.backgrounds, BACKGROUNDS_TTL_S)
        self.images = FingerImages(daemon)
        self.frames = {finger: FrameBroadcast(partial(daemon.frame, finger)) for finger in FINGERS}
        self.live = LiveStream(self.state.get)
        self.estimates = EstimateStream(daemon)

    def invalidate(self) -> None:
        """Discard cached responses after a request, which may have changed them."""
        for cache in (self.state, self.health_problem, self.backgrounds):
            cache.invalidate()

    async def run(self) -> None:
        """Run the live stream until cancelled."""
        unsubscribe = self.daemon.subscribe(self.live.publish_event)
        try:
            await self.live.run()
        finally:
            unsubscribe()
