"""Requests from outside that wait for the next cycle of the loop, and their responses."""

from __future__ import annotations

import asyncio

from slipguard.control.messages import ControlRequest
from slipguard.errors import CommandRefused

REQUEST_TIMEOUT_S = 2.0


class PendingRequest:
    """One request whose caller waits for a response."""

    def __init__(self, request: ControlRequest) -> None:
        self.request = request
        self.response: asyncio.Future[str] = asyncio.get_running_loop().create_future()

    def respond(self, message: str) -> None:
        """Give the caller a message, if it still waits."""
        if not self.response.done():
            self.response.set_result(message)

    def refuse(self, reason: str) -> None:
        """Raise CommandRefused in the caller, if it still waits."""
        if not self.response.done():
            self.response.set_exception(CommandRefused(reason))


class RequestQueue:
    """Requests in the order of their arrival."""

    def __init__(self) -> None:
        self._pending: asyncio.Queue[PendingRequest] = asyncio.Queue()

    async def submit(self, request: ControlRequest, wake: asyncio.Event) -> str:
        """Add a request, wake the loop and return the response. Raises CommandRefused with the reason."""
        pending = PendingRequest(request)
        self._pending.put_nowait(pending)
        wake.set()
        try:
            async with asyncio.timeout(REQUEST_TIMEOUT_S):
                return await pending.response
        except TimeoutError:
            raise CommandRefused(
                f"{request.kind}: the loop did not respond within {REQUEST_TIMEOUT_S:g} s; try again"
            ) from None

    def next(self) -> PendingRequest | None:
        """Return the oldest request whose caller still waits; one that was given up is not carried out later."""
        while not self._pending.empty():
            pending = self._pending.get_nowait()
            if not pending.response.done():
                return pending
        return None

    def refuse_all(self, reason: str) -> None:
        """Refuse every waiting request."""
        while (pending := self.next()) is not None:
            pending.refuse(f"{pending.request.kind}: {reason}")
