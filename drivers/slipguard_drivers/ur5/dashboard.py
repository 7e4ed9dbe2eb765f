"""Client of the controller's dashboard server: one line as request, one line as response."""

from __future__ import annotations

import asyncio
import contextlib

from slipguard.errors import DeviceLost
from slipguard_drivers.ur5.rtde import connect_tcp

PORT = 29999
RESPONSE_TIMEOUT_S = 1.0
STOP_TIMEOUT_S = 0.3
OUTDATED = "reconnect to port"
"""A connection that was made in local control stays refused after the robot is switched to remote control."""


class DashboardClient:
    """One connection, made when it is needed and made again after it was lost. Requests are sent one at a time."""

    def __init__(self, name: str, host: str) -> None:
        self._name, self._host = name, host
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._lock = asyncio.Lock()

    async def ask(self, line: str, timeout_s: float = RESPONSE_TIMEOUT_S) -> str:
        """Send a question or command and return the response without its newline. Raises DeviceLost on a time-out."""
        async with self._lock:
            reused = self._streams is not None
            try:
                response = await self._exchange(line, timeout_s)
                if not (reused and OUTDATED in response):
                    return response
                self.close()
            except DeviceLost:
                if not reused:
                    raise
            return await self._exchange(line, timeout_s)  # the old connection may have been lost unnoticed

    async def in_remote_control(self) -> bool:
        """Return whether the robot accepts commands over the network. A CB3 always does."""
        return "false" not in (await self.ask("is in remote control")).lower()

    def close(self) -> None:
        """Disconnect. Idempotent."""
        if self._streams is not None:
            self._streams[1].transport.abort()
            self._streams = None

    async def _exchange(self, line: str, timeout_s: float) -> str:
        try:
            async with asyncio.timeout(timeout_s):
                if self._streams is None:
                    self._streams = await connect_tcp(self._name, self._host, PORT, "dashboard")
                    await self._read_line()  # the greeting
                self._streams[1].write(line.encode() + b"\n")
                return await self._read_line()
        except TimeoutError:
            self.close()  # a late response must not be taken for the next one
            raise DeviceLost(
                f"{self._name}: {self._host}:{PORT} (dashboard) did not answer `{line}` within {timeout_s:g} s; "
                "check the network cable"
            ) from None
        except BaseException:
            self.close()
            raise

    async def _read_line(self) -> str:
        assert self._streams is not None
        try:
            line = await self._streams[0].readline()
        except (OSError, ValueError):
            line = b""
        if not line.endswith(b"\n"):
            raise DeviceLost(f"{self._name}: {self._host}:{PORT} (dashboard) closed the connection")
        return line.decode("ascii", "replace").strip()


async def stop_program(name: str, host: str) -> bool:
    """Stop the running or paused program over a connection of its own; return whether the dashboard answered."""
    dashboard, answered = DashboardClient(name, host), False
    with contextlib.suppress(DeviceLost):
        await dashboard.ask("stop", timeout_s=STOP_TIMEOUT_S)
        answered = True
    dashboard.close()
    return answered
