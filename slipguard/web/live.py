"""The live stream: ten states a second and every event, to whoever looks.

The daemon is asked once for all of them. Whoever cannot keep up loses messages; nobody waits for him.
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

from slipguard.daemon.loop.event_log import KEPT, Event
from slipguard.daemon.loop.ticker import Ticker
from slipguard.errors import SlipguardError

PERIOD_S = 0.1
HISTORY = 600
"""A minute of samples."""
SEND_S = 10.0
"""A client that takes nothing for so long is dropped."""
log = structlog.get_logger()


class LiveClient:
    """What waits for one client: events, the oldest dropped where they are too many, and the newest state alone."""

    def __init__(self) -> None:
        self._events: deque[str] = deque(maxlen=KEPT)
        self._state: str | None = None
        self._news = asyncio.Event()

    def tell(self, event: str) -> None:
        """Leave an event for it."""
        self._events.append(event)
        self._news.set()

    def show(self, state: str) -> None:
        """Leave a state for it, in place of one not yet taken."""
        self._state = state
        self._news.set()

    async def next(self) -> list[str]:
        """What there is, as soon as there is anything."""
        await self._news.wait()
        self._news.clear()
        told = list(self._events)
        self._events.clear()
        if self._state is not None:
            told.append(self._state)
            self._state = None
        return told


class LiveStream:
    """state: asks the daemon, and gives a JSON object. Call `run`, and `hear` for each event."""

    def __init__(self, state: Callable[[], Awaitable[bytes]]) -> None:
        self._state = state
        self._samples: deque[dict[str, Any]] = deque(maxlen=HISTORY)
        self._events: deque[str] = deque(maxlen=KEPT)
        self._listeners: set[LiveClient] = set()

    def hear(self, event: Event) -> None:
        """Pass an event on at once."""
        text = json.dumps({"type": "event", "event": asdict(event)})
        self._events.append(text)
        for listener in self._listeners:
            listener.tell(text)

    async def run(self) -> None:
        """Look ten times a second, until cancelled."""
        ticker = Ticker(PERIOD_S)
        told: str | None = None
        while True:
            await ticker.wait()
            try:
                self.look(await self._state())
            except SlipguardError:
                continue  # a daemon that does not answer shows nothing new
            except Exception as mistake:  # a page that stays as it is for ever would look alive
                if repr(mistake) != told:
                    told = repr(mistake)
                    log.exception("the page has missed a state")

    def look(self, raw: bytes) -> None:
        """Keep a sample of a state, a JSON object, and show the state to all."""
        sample = sample_of(json.loads(raw))
        self._samples.append(sample)
        if not self._listeners:
            return
        text = f'{{"type": "state", "sample": {json.dumps(sample)}, "state": {raw.decode()}}}'
        for listener in self._listeners:
            listener.show(text)

    async def serve(self, socket: WebSocket) -> None:
        """History, the events kept, then everything as it comes, until the client goes or takes nothing any more."""
        listener = LiveClient()
        await socket.accept()
        told = [json.dumps({"type": "history", "samples": list(self._samples)}), *self._events]
        self._listeners.add(listener)
        gone = asyncio.create_task(_gone(socket), name="live: client")
        try:
            while not gone.done():
                for text in told:
                    async with asyncio.timeout(SEND_S):
                        await socket.send_text(text)
                news = asyncio.create_task(listener.next(), name="live: news")
                await asyncio.wait((news, gone), return_when=asyncio.FIRST_COMPLETED)
                if not news.done():
                    news.cancel()
                    break
                told = news.result()
        except (TimeoutError, WebSocketDisconnect, RuntimeError):
            pass
        finally:
            self._listeners.discard(listener)
            gone.cancel()


async def _gone(socket: WebSocket) -> None:
    """Until the client has gone; what it says is not listened to."""
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


def sample_of(state: dict[str, Any]) -> dict[str, Any]:
    """What a minute's curves are drawn from; None where it is not known."""
    rotation, gripper = state.get("rotation") or {}, state.get("gripper") or {}
    return {
        "t_s": state.get("now_s"),
        "rotation_deg": rotation.get("rotation_deg"),
        "sigma_deg": rotation.get("sigma_deg"),
        "force_n": gripper.get("force_n"),
        "target_n": state.get("target_force_n"),
        "phase": state.get("phase"),
        "slipping": state.get("slipping"),
    }
