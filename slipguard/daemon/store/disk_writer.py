"""Writes to the disk outside the loop, one at a time. A failing disk is logged once and retried after a pause."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

RETRY_S = 5.0


class DiskWriter:
    """Runs one write at a time in a thread.

    Args:
        name: Name of its task.
        what: What is written, as the beginning of a log line.
        info: Receives one line when writing works again.
        warning: Receives one line when writing fails.
    """

    def __init__(self, name: str, what: str, info: Callable[[str], None], warning: Callable[[str], None]) -> None:
        self._name, self._what, self._info, self._warning = name, what, info, warning
        self._task: asyncio.Task[None] | None = None
        self._reason: str | None = None
        self._retry_at_s = 0.0

    @property
    def busy(self) -> bool:
        """Whether a write is running."""
        return self._task is not None and not self._task.done()

    @property
    def failed(self) -> bool:
        """Whether the last write failed."""
        return self._reason is not None

    @property
    def due(self) -> bool:
        """Whether the last write failed and is to be retried now."""
        return self.failed and asyncio.get_running_loop().time() >= self._retry_at_s

    def begin(self, write: Callable[[], None]) -> None:
        """Call `write` in a thread; not while `busy`."""
        self._task = asyncio.get_running_loop().create_task(self._run(write), name=self._name)

    async def _run(self, write: Callable[[], None]) -> None:
        try:
            await asyncio.to_thread(write)
        except Exception as error:  # no failure may end the guard
            before, self._reason = self._reason, getattr(error, "strerror", None) or str(error) or type(error).__name__
            self._retry_at_s = asyncio.get_running_loop().time() + RETRY_S
            if self._reason != before:
                self._warning(f"{self._what} could not be saved for a restart: {self._reason}; check the disk")
        else:
            if self.failed:
                self._info(f"{self._what} can be saved for a restart again")
            self._reason = None
