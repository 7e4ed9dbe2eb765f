"""The live stream: the state ten times per second and every event, to all connected pages.

The daemon is called once for all clients. A slow client misses messages; it does not delay the others.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import Any

import structlog
from starlette.websockets import WebSocket

from slipguard.daemon.api.state import State
from slipguard.daemon.loop.async_tools import Ticker
from slipguard.daemon.loop.event_log import KEPT, Event
from slipguard.errors import SlipguardError
from slipguard.web.streams import Outbox, send, send_outbox, send_until_disconnected

PERIOD_S = 0.1
HISTORY_SAMPLES = 600
"""One minute."""
log = structlog.get_logger()


class LiveStream:
    """fetch_state: returns the daemon's state, a JSON object. Call `run`, and `publish_event` for each event."""

    def __init__(self, fetch_state: Callable[[], Awaitable[bytes]]) -> None:
        self._fetch_state = fetch_state
        self._samples: deque[dict[str, Any]] = deque(maxlen=HISTORY_SAMPLES)
        self._events: deque[str] = deque(maxlen=KEPT)
        self._outboxes: set[Outbox] = set()

    def publish_event(self, event: Event) -> None:
        """Send an event to all clients."""
        text = json.dumps({"type": "event", "event": asdict(event)})
        self._events.append(text)
        for outbox in self._outboxes:
            outbox.add(text)

    async def run(self) -> None:
        """Fetch and publish the state ten times per second, until cancelled."""
        ticker = Ticker(PERIOD_S)
        logged: str | None = None
        while True:
            await ticker.wait()
            try:
                self.publish_state(await self._fetch_state())
            except SlipguardError:
                continue  # the daemon did not respond: there is no new state
            except Exception as bug:  # without this, the page would keep showing an old state
                if repr(bug) != logged:
                    logged = repr(bug)
                    log.exception("the live stream has missed a state")

    def publish_state(self, raw: bytes) -> None:
        """Keep a sample of a state, a JSON object, for the history, and send the state to all clients."""
        sample = sample_of(State.model_validate_json(raw))
        self._samples.append(sample)
        if not self._outboxes:
            return
        text = f'{{"type": "state", "sample": {json.dumps(sample)}, "state": {raw.decode()}}}'
        for outbox in self._outboxes:
            outbox.set_state(text)

    async def serve(self, socket: WebSocket) -> None:
        """Send history, recent events, then all new messages, until the client disconnects or stops receiving."""
        outbox = Outbox(KEPT)

        async def send_all() -> None:
            earlier = [json.dumps({"type": "history", "samples": list(self._samples)}), *self._events]
            self._outboxes.add(outbox)
            for message in earlier:
                await send(socket, message)
            await send_outbox(socket, outbox)

        try:
            await send_until_disconnected(socket, send_all)
        finally:
            self._outboxes.discard(outbox)


def sample_of(state: State) -> dict[str, Any]:
    """Return the values that the page's charts show; None for unknown values."""
    rotation, gripper = state.rotation, state.gripper
    return {
        "t_s": state.now_s,
        "rotation_deg": rotation.rotation_deg if rotation is not None else None,
        "sigma_deg": rotation.sigma_deg if rotation is not None else None,
        "force_n": gripper.force_n if gripper is not None and gripper.force_known else None,
        "target_n": state.target_force_n,
        "phase": state.phase,
        "slipping": state.slipping,
    }
