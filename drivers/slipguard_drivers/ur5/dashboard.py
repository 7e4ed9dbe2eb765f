"""The controller's dashboard as a client: one line asked, one line answered."""

from __future__ import annotations

import asyncio

from slipguard.errors import DeviceLost
from slipguard_drivers.ur5.rtde import reach

PORT = 29999
ANSWER_S = 1.0
STALE = "reconnect to port"
"""A connection made in local control stays refused when the robot is switched to remote control."""


class DashboardClient:
    """One connection, made when it is needed and again when it is gone. Questions and orders are put one at a time."""

    def __init__(self, name: str, host: str) -> None:
        self._name, self._host = name, host
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._rotation = asyncio.Lock()

    async def ask(self, line: str, deadline_s: float = ANSWER_S) -> str:
        """Ask or order; the answer without its newline. Raises DeviceLost where there is none in time."""
        async with self._rotation:
            kept = self._streams is not None
            try:
                answer = await self._exchange(line, deadline_s)
                if not (kept and STALE in answer):
                    return answer
                self.close()
            except DeviceLost:
                if not kept:
                    raise
            return await self._exchange(line, deadline_s)  # what was kept may have died unnoticed

    async def in_remote_control(self) -> bool:
        """Whether the robot takes orders from here. A CB3 always does."""
        return "false" not in (await self.ask("is in remote control")).lower()

    def close(self) -> None:
        """Hang up. Idempotent."""
        if self._streams is not None:
            self._streams[1].transport.abort()
            self._streams = None

    async def _exchange(self, line: str, deadline_s: float) -> str:
        try:
            async with asyncio.timeout(deadline_s):
                if self._streams is None:
                    self._streams = await reach(self._name, self._host, PORT, "dashboard")
                    await self._line()  # its greeting
                self._streams[1].write(line.encode() + b"\n")
                return await self._line()
        except TimeoutError:
            self.close()  # a late answer must not be taken for the next one
            raise DeviceLost(
                f"{self._name}: {self._host}:{PORT} (dashboard) did not answer `{line}` in {deadline_s:g} s"
            ) from None
        except BaseException:
            self.close()
            raise

    async def _line(self) -> str:
        assert self._streams is not None
        try:
            line = await self._streams[0].readline()
        except (OSError, ValueError):
            line = b""
        if not line.endswith(b"\n"):
            raise DeviceLost(f"{self._name}: {self._host}:{PORT} (dashboard) has closed the connection")
        return line.decode("ascii", "replace").strip()
