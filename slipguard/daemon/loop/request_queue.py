"""Requests from outside that wait for the next cycle of the loop, and their responses."""

from __future__ import annotations

import asyncio
from collections import deque

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.errors import CommandRefused

REQUEST_TIMEOUT_S = 2.0
NOT_STOPPED = (RequestKind.STOP, RequestKind.RELEASE)
"""A stop takes back no other stop, and no release: jaws that were to open free a hand."""


class PendingRequest:
    """One request whose caller waits for a response.

    deadline_s: Loop time after which it is not executed.
    """

    def __init__(self, request: ControlRequest, deadline_s: float) -> None:
        self.request, self.deadline_s = request, deadline_s
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
    """Requests in the order of their arrival. What was reported as failed is never executed.

    A stop comes first, and refuses what waits: after it, nothing moves until the next request.
    """

    def __init__(self) -> None:
        self._pending: deque[PendingRequest] = deque()

    async def submit(self, request: ControlRequest, wake: asyncio.Event, deadline_s: float) -> str:
        """Add a request, wake the loop and return the response.

        Raises CommandRefused with the reason, also if no cycle has taken the request by `deadline_s` (loop time) or
        within `REQUEST_TIMEOUT_S`.
        """
        loop = asyncio.get_running_loop()
        now_s = loop.time()
        if now_s >= deadline_s:
            raise CommandRefused(f"{request.kind}: took too long to prepare and was not executed; send it again")
        pending = PendingRequest(request, min(deadline_s, now_s + REQUEST_TIMEOUT_S))
        if request.kind is RequestKind.STOP:
            self._refuse("a stop was requested after it; not executed", kept=NOT_STOPPED)
            self._pending.appendleft(pending)
        else:
            self._pending.append(pending)
        wake.set()
        # Not `asyncio.timeout`: it could report a request as failed that a cycle has just executed.
        timer = loop.call_at(pending.deadline_s, pending.refuse, _too_late(pending))
        try:
            return await pending.response
        finally:
            timer.cancel()

    def next(self, now_s: float) -> PendingRequest | None:
        """Return the oldest request whose caller still waits and whose deadline has not passed; refuse the others."""
        while self._pending:
            pending = self._pending.popleft()
            if now_s >= pending.deadline_s:
                pending.refuse(_too_late(pending))
            if not pending.response.done():
                return pending
        return None

    def refuse_all(self, reason: str) -> None:
        """Refuse every waiting request."""
        self._refuse(reason)

    def _refuse(self, reason: str, kept: tuple[RequestKind, ...] = ()) -> None:
        for pending in [one for one in self._pending if one.request.kind not in kept]:
            self._pending.remove(pending)
            pending.refuse(f"{pending.request.kind}: {reason}")


def _too_late(pending: PendingRequest) -> str:
    return f"{pending.request.kind}: the loop did not respond within {REQUEST_TIMEOUT_S:g} s; not executed, try again"
