"""What all WebSockets of the API share: a client that is slow or gone delays no other, and costs bounded memory."""

from __future__ import annotations

import asyncio
import contextlib
from collections import deque
from collections.abc import Awaitable, Callable

from starlette.websockets import WebSocket, WebSocketDisconnect

from slipguard.daemon.api.daemon_api import DaemonApi

SEND_TIMEOUT_S = 10.0
"""A client that receives nothing for this time is disconnected."""
ESTIMATES_MAX = 240
"""Messages that wait for one client: two seconds of two cameras at 60 fps, 300 kB."""


class Outbox:
    """Messages that wait for one client: the newest `kept` of a sequence, and only the newest state."""

    def __init__(self, kept: int) -> None:
        self._messages: deque[str] = deque(maxlen=kept)
        self._state: str | None = None
        self._ready = asyncio.Event()

    def add(self, message: str) -> None:
        """Add a message; the oldest one that waits may be lost."""
        self._messages.append(message)
        self._ready.set()

    def set_state(self, state: str) -> None:
        """Set the state to be sent; replaces one that was not sent yet."""
        self._state = state
        self._ready.set()

    async def next(self) -> list[str]:
        """Wait for messages and return them."""
        await self._ready.wait()
        self._ready.clear()
        messages = list(self._messages)
        self._messages.clear()
        if self._state is not None:
            messages.append(self._state)
            self._state = None
        return messages


async def send_until_disconnected(socket: WebSocket, send_all: Callable[[], Awaitable[None]]) -> None:
    """Accept a client and run `send_all` until it ends or the client has gone. What the client sends is ignored."""

    async def run() -> None:
        with contextlib.suppress(TimeoutError, WebSocketDisconnect, RuntimeError):
            await send_all()

    await socket.accept()
    sending = asyncio.create_task(run(), name="web: send")
    disconnected = asyncio.create_task(_wait_for_disconnect(socket), name="web: client")
    try:
        await asyncio.wait((sending, disconnected), return_when=asyncio.FIRST_COMPLETED)
    finally:
        sending.cancel()
        disconnected.cancel()
        await asyncio.gather(sending, disconnected, return_exceptions=True)
    if not sending.cancelled():
        sending.result()


async def send(socket: WebSocket, message: str | bytes) -> None:
    """Send one message. Raises TimeoutError if the client does not receive it within `SEND_TIMEOUT_S`."""
    async with asyncio.timeout(SEND_TIMEOUT_S):
        await (socket.send_text(message) if isinstance(message, str) else socket.send_bytes(message))


async def send_outbox(socket: WebSocket, outbox: Outbox) -> None:
    """Send what an outbox receives, until the client has gone."""
    while True:
        for message in await outbox.next():
            await send(socket, message)


async def _wait_for_disconnect(socket: WebSocket) -> None:
    while (await socket.receive())["type"] != "websocket.disconnect":
        pass


class EstimateStream:
    """Every new estimate as soon as the control loop has used it; the daemon sends them while there is a client."""

    def __init__(self, daemon: DaemonApi) -> None:
        self._subscribe = daemon.subscribe_estimates
        self._outboxes: set[Outbox] = set()
        self._unsubscribe: Callable[[], None] | None = None

    async def serve(self, socket: WebSocket) -> None:
        """Send new estimates until the client disconnects or stops receiving; the oldest that wait are lost first."""
        outbox = Outbox(ESTIMATES_MAX)
        self._outboxes.add(outbox)
        if self._unsubscribe is None:
            self._unsubscribe = self._subscribe(self._publish)
        try:
            await send_until_disconnected(socket, lambda: send_outbox(socket, outbox))
        finally:
            self._outboxes.discard(outbox)
            if not self._outboxes and self._unsubscribe is not None:
                self._unsubscribe()
                self._unsubscribe = None

    def _publish(self, estimates: bytes) -> None:
        text = estimates.decode()
        for outbox in self._outboxes:
            outbox.add(text)
