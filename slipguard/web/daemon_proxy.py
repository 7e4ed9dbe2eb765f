"""The daemon's API as the web process uses it: every call goes over the socket to the daemon, events come back."""

from __future__ import annotations

import asyncio
import itertools
import time
from collections.abc import Callable, Mapping
from typing import Any

from slipguard.daemon.api.daemon_api import DaemonApi, FingerFrame
from slipguard.daemon.api.requests import EXECUTE_WITHIN_S, DaemonRequest
from slipguard.daemon.loop.event_log import KEPT, Event
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.web.protocol import decode_finger_frame, encode_message, read_message

RESPONSE_TIMEOUT_S = 5.0
Response = tuple[dict[str, Any], bytes]


class DaemonInternalError(Exception):
    """A bug in the daemon; its log has the details."""


class DaemonProxy(DaemonApi):
    """Call `run`. Methods raise CommandRefused, or SlipguardError if the daemon does not respond in time."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._reader, self._writer = reader, writer
        self._ids = itertools.count()
        self._pending: dict[int, asyncio.Future[Response]] = {}
        self._events: list[Event] = []
        self._subscribers: list[Callable[[Event], None]] = []
        self._estimate_subscribers: list[Callable[[bytes], None]] = []
        self.stop = asyncio.Event()
        """Set when the daemon asks the web process to stop."""

    async def run(self) -> None:
        """Receive messages until the daemon closes the connection."""
        while (received := await read_message(self._reader)) is not None:
            message, data = received
            if message.get("stop"):
                self.stop.set()
            elif "event" in message:
                self._publish(Event(**message["event"]))
            elif "estimates" in message:
                for on_estimates in self._estimate_subscribers:
                    on_estimates(data)
            elif (pending := self._pending.get(message["id"])) is not None and not pending.done():
                pending.set_result((message, data))

    def _publish(self, event: Event) -> None:
        self._events = [*self._events[1 - KEPT :], event]
        for on_event in self._subscribers:
            on_event(event)

    def subscribe(self, on_event: Callable[[Event], None]) -> Callable[[], None]:
        for event in self._events:
            on_event(event)
        self._subscribers.append(on_event)
        return lambda: self._subscribers.remove(on_event)

    def subscribe_estimates(self, on_estimates: Callable[[bytes], None]) -> Callable[[], None]:
        def unsubscribe() -> None:
            self._estimate_subscribers.remove(on_estimates)
            self._request_estimates()

        self._estimate_subscribers.append(on_estimates)
        self._request_estimates()
        return unsubscribe

    def _request_estimates(self) -> None:
        self._writer.write(b"".join(encode_message({"estimates": bool(self._estimate_subscribers)})))

    async def _call(
        self, method: str, arguments: Mapping[str, object] | None = None, timeout_s: float = RESPONSE_TIMEOUT_S
    ) -> Response:
        number = next(self._ids)
        response: asyncio.Future[Response] = asyncio.get_running_loop().create_future()
        self._pending[number] = response
        try:
            self._writer.write(b"".join(encode_message({"id": number, "call": method, "arguments": arguments or {}})))
            async with asyncio.timeout(timeout_s):
                message, data = await response
        except (TimeoutError, ConnectionError):
            raise SlipguardError(f"the daemon did not respond within {timeout_s:g} s") from None
        finally:
            del self._pending[number]
        if "refused" in message:
            raise CommandRefused(message["refused"])
        if "failed" in message:
            raise SlipguardError(message["failed"])
        if "bug" in message:
            raise DaemonInternalError(message["bug"])
        return message, data

    async def submit(self, request: DaemonRequest, deadline_s: float | None = None) -> Mapping[str, object]:
        arguments = {
            "kind": request.kind,
            "fields": request.model_dump(mode="json"),
            "deadline_s": deadline_s or time.monotonic() + EXECUTE_WITHIN_S,  # one clock for all processes of a machine
        }
        message, _ = await self._call("submit", arguments, request.response_timeout_s)
        result: dict[str, object] = message["result"]
        return result

    async def state(self) -> bytes:
        return (await self._call("state"))[1]

    async def health_problem(self) -> str | None:
        problem: str | None = (await self._call("health_problem"))[0]["result"]
        return problem

    async def counters(self) -> bytes:
        return (await self._call("counters"))[1]

    async def backgrounds(self) -> bytes:
        return (await self._call("backgrounds"))[1]

    async def frame(self, finger: str, after: int | None = None) -> FingerFrame:
        return await self._call_for_frame("frame", {"finger": finger, "after": after})

    async def processed_frame(self, finger: str) -> FingerFrame:
        return await self._call_for_frame("processed_frame", {"finger": finger})

    async def background(self, finger: str, number: int | None = None) -> FingerFrame:
        return await self._call_for_frame("background", {"finger": finger, "number": number})

    async def _call_for_frame(self, method: str, arguments: Mapping[str, object]) -> FingerFrame:
        message, data = await self._call(method, arguments)
        return decode_finger_frame(message["result"], data)
