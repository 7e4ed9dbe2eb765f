"""Numbered requests on a TCP connection: the response to `7 state` is `7 ok 41.2 0` or `7 refused REASON`."""

import asyncio
from itertools import count

from slipguard.errors import CommandRefused, DeviceLost, DeviceTimeout
from slipguard.host_lookup import resolve_host


class TextLink:
    def __init__(self, name: str, host: str, port: int, timeout_ms: float) -> None:
        self._name, self._host, self._port, self._timeout_s = name, host, port, timeout_ms / 1000.0
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None
        self._one_at_a_time = asyncio.Lock()
        self._numbers = count(1)

    @property
    def connected(self) -> bool:
        return self._streams is not None

    async def open(self) -> None:
        if self._streams is None:
            try:
                async with asyncio.timeout(self._timeout_s):
                    # asyncio's own lookup of a name would block threads that other devices need.
                    self._streams = await asyncio.open_connection(await resolve_host(self._host), self._port)
            except (OSError, TimeoutError) as error:
                why = f"{self._host}:{self._port} ({str(error) or 'no answer'})"
                raise DeviceLost(f"{self._name}: no connection to {why}. Check power and cable.") from None

    async def ask(self, request: str) -> list[str]:
        """Send one request and return the words of its response."""
        async with self._one_at_a_time:
            if self._streams is None:
                raise DeviceLost(f"{self._name}: not open; call open() first")
            reader, writer = self._streams
            number, answered = str(next(self._numbers)), ""
            try:
                async with asyncio.timeout(self._timeout_s):
                    writer.write(f"{number} {request}\n".encode())
                    while answered != number:  # skip late responses to requests that timed out or were cancelled
                        answered, status, *words = (await reader.readuntil()).decode().split()
            except TimeoutError:
                raise DeviceTimeout(f"{self._name}: no response within {self._timeout_s:g} s. Check power.") from None
            except (OSError, EOFError, ValueError):
                self.close()
                raise DeviceLost(f"{self._name}: connection lost. Check power and cable.") from None
        if status != "ok":
            raise CommandRefused(f"{self._name}: {' '.join(words)}")
        return words

    def close(self) -> None:
        if self._streams is not None:
            self._streams[1].close()
            self._streams = None
