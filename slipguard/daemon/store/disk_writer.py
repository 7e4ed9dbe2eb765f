"""Writes beside the loop, one at a time; a disk that fails is said once, and asked again when it may be mended."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

TRY_AGAIN_S = 5.0


class DiskWriter:
    """name: of its task. what: it is that is noted down, as a line begins with it.

    warn: told of trouble. say: of its end.
    """

    def __init__(self, name: str, what: str, say: Callable[[str], None], warn: Callable[[str], None]) -> None:
        self._name, self._what, self._say, self._warn = name, what, say, warn
        self._writing: asyncio.Task[None] | None = None
        self._why: str | None = None
        self._again_at_s = 0.0

    @property
    def busy(self) -> bool:
        """Whether something is being written."""
        return self._writing is not None and not self._writing.done()

    @property
    def failed(self) -> bool:
        """Whether the last write did."""
        return self._why is not None

    @property
    def due(self) -> bool:
        """Whether the last write failed so long ago that it is to be tried again."""
        return self.failed and asyncio.get_running_loop().time() >= self._again_at_s

    def begin(self, work: Callable[[], None]) -> None:
        """Do it in a thread; not while `busy`."""
        self._writing = asyncio.get_running_loop().create_task(self._do(work), name=self._name)

    async def _do(self, work: Callable[[], None]) -> None:
        try:
            await asyncio.to_thread(work)
        except Exception as error:  # whatever it is, the guard must not end with it
            before, self._why = self._why, getattr(error, "strerror", None) or str(error) or type(error).__name__
            self._again_at_s = asyncio.get_running_loop().time() + TRY_AGAIN_S
            if self._why != before:
                self._warn(f"{self._what} could not be noted down for a restart: {self._why}")
        else:
            if self.failed:
                self._say(f"{self._what} can be noted down for a restart again")
            self._why = None
