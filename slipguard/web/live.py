"""The live stream: the state ten times per second and every event, to all connected pages.

The daemon is called once for all clients. A slow client misses messages; it does not delay the others.
"""

from __future__ import annotations

import asyncio
import json
from collections import deque
from collections.abc import Awaitable, Callable
from dataclasses import asdict
from typing import Any

import structlog
from starlette.websockets import WebSocket, WebSocketDisconnect

from slipguard.daemon.loop.async_tools import Ticker
from slipguard.daemon.loop.event_log import KEPT, Event
from slipguard.errors import SlipguardError

PERIOD_S = 0.1
HISTORY_SAMPLES = 600
"""One minute."""
SEND_TIMEOUT_S = 10.0
"""A client that receives nothing for this time is disconnected."""
log = structlog.get_logger()


class LiveClient:
    """Messages waiting for one client: the newest events, and only the newest state."""

    def __init__(self) -> None:
        self._events: deque[str] = deque(maxlen=KEPT)
        self._state: str | None = None
        self._ready = asyncio.Event()

    def add_event(self, event: str) -> None:
        """Add an event."""
        self._events.append(event)
        self._ready.set()

    def set_state(self, state: str) -> None:
        """Set the state to be sent; replaces one that was not sent yet."""
        self._state = state
        self._ready.set()

    async def next(self) -> list[str]:
        """Wait for messages and return them."""
        await self._ready.wait()
        self._ready.clear()
        messages = list(self._events)
        self._events.clear()
        if self._state is not None:
            messages.append(self._state)
            self._state = None
        return messages


class LiveStream:
    """fetch_state: returns the daemon's state, a JSON object. Call `run`, and `publish_event` for each event."""

    def __init__(self, fetch_state: Callable[[], Awaitable[bytes]]) -> None:
        self._fetch_state = fetch_state
        self._samples: deque[dict[str, Any]] = deque(maxlen=HISTORY_SAMPLES)
        self._events: deque[str] = deque(maxlen=KEPT)
        self._clients: set[LiveClient] = set()

    def publish_event(self, event: Event) -> None:
        """Send an event to all clients."""
        text = json.dumps({"type": "event", "event": asdict(event)})
        self._events.append(text)
        for client in self._clients:
            client.add_event(text)

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
        sample = sample_of(json.loads(raw))
        self._samples.append(sample)
        if not self._clients:
            return
        text = f'{{"type": "state", "sample": {json.dumps(sample)}, "state": {raw.decode()}}}'
        for client in self._clients:
            client.set_state(text)

    async def serve(self, socket: WebSocket) -> None:
        """Send history, recent events, then all new messages, until the client disconnects or stops receiving."""
        client = LiveClient()
        await socket.accept()
        messages = [json.dumps({"type": "history", "samples": list(self._samples)}), *self._events]
        self._clients.add(client)
        disconnected = asyncio.create_task(wait_for_disconnect(socket), name="live: client")
        try:
            while not disconnected.done():
                for text in messages:
                    async with asyncio.timeout(SEND_TIMEOUT_S):
                        await socket.send_text(text)
                next_messages = asyncio.create_task(client.next(), name="live: messages")
                await asyncio.wait((next_messages, disconnected), return_when=asyncio.FIRST_COMPLETED)
                if not next_messages.done():
                    next_messages.cancel()
                    break
                messages = next_messages.result()
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            pass
        finally:
            self._clients.discard(client)
            disconnected.cancel()


async def wait_for_disconnect(socket: WebSocket) -> None:
    """Return when the client has disconnected; messages from it are ignored."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


def sample_of(state: dict[str, Any]) -> dict[str, Any]:
    """Return the values that the page's charts show, from a state; None for unknown values."""
    rotation, gripper = state.get("rotation") or {}, state.get("gripper") or {}
    return {
        "t_s": state.get("now_s"),
        "rotation_deg": rotation.get("rotation_deg"),
        "sigma_deg": rotation.get("sigma_deg"),
        "force_n": gripper.get("force_n") if gripper.get("force_known", True) else None,
        "target_n": state.get("target_force_n"),
        "phase": state.get("phase"),
        "slipping": state.get("slipping"),
    }
