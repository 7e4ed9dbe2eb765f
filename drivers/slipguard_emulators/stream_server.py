"""A listening socket that comes and goes, and the connections to it."""

from __future__ import annotations

import asyncio
import os
import socket
import struct
from collections.abc import Callable, Coroutine
from pathlib import Path

from slipguard.errors import InputError

Client = tuple[asyncio.StreamReader, asyncio.StreamWriter]
INVALID = (asyncio.IncompleteReadError, OSError, ValueError, IndexError, struct.error)
"""What a client that leaves or sends invalid data raises: its connection ends."""


class StreamServer:
    """Serves clients of one TCP port or Unix socket.

    address: host and port, of which port 0 becomes a free one, or the path of a Unix socket. serve: called with each
    client; the connection ends when it returns.
    """

    def __init__(self, address: tuple[str, int] | Path, serve: Callable[[Client], Coroutine[None, None, None]]) -> None:
        self._address = address
        self._serve = serve
        self._listening: socket.socket | None = None
        self._tasks: set[asyncio.Task[None]] = set()
        self._accepting: asyncio.Task[None] | None = None
        self.plugs = 0
        """How often the socket was created."""

    @property
    def path(self) -> str:
        """HOST:PORT, or the path."""
        return str(self._address) if isinstance(self._address, Path) else "{}:{}".format(*self._address)

    @property
    def plugged(self) -> bool:
        """Whether clients can connect."""
        return self._listening is not None

    def plug(self) -> None:
        """Create the socket. Idempotent. Raises InputError if that is not possible."""
        if self._listening is not None:
            return
        try:
            self._listening = self._bind()
        except OSError as error:
            raise InputError(
                f"cannot listen on {self.path} ({os.strerror(error.errno or 0)}); name another port, or another "
                "address of this machine, such as 127.0.0.2"
            ) from None
        self._listening.setblocking(False)
        if not isinstance(self._address, Path):
            self._address = self._listening.getsockname()[:2]
        self.plugs += 1
        self._accepting = self._start(self._accept(self._listening))

    def unplug(self) -> None:
        """Remove the socket and disconnect, even in the middle of a message. Idempotent."""
        if self._listening is not None:
            asyncio.get_running_loop().remove_reader(self._listening)  # its number may be used again at once
            self._listening.close()
            self._listening = None
            if isinstance(self._address, Path):
                self._address.unlink(missing_ok=True)
        if self._accepting is not None:
            self._accepting.cancel()
        self.cut()

    def cut(self) -> None:
        """End all connections."""
        for task in self._tasks - {self._accepting}:
            task.cancel()

    async def close(self) -> None:
        """Remove the socket and wait until all connections have ended."""
        self.unplug()
        while self._tasks:
            await asyncio.wait(self._tasks)

    def _bind(self) -> socket.socket:
        if not isinstance(self._address, Path):
            return socket.create_server(self._address)
        self._address.unlink(missing_ok=True)
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        try:
            listening.bind(str(self._address))
            listening.listen(4)
        except OSError:
            listening.close()
            raise
        return listening

    def _start(self, work: Coroutine[None, None, None]) -> asyncio.Task[None]:
        task: asyncio.Task[None] = asyncio.create_task(work, name=f"{self.path}: client")
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
        return task

    async def _accept(self, listening: socket.socket) -> None:
        loop = asyncio.get_running_loop()
        while True:
            connection, _ = await loop.sock_accept(listening)
            if connection.family != socket.AF_UNIX:
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._start(self._connected(await asyncio.open_connection(sock=connection)))

    async def _connected(self, client: Client) -> None:
        writer = client[1]
        try:
            await self._serve(client)
        except asyncio.CancelledError:
            writer.transport.abort()
            raise
        except INVALID:
            return
        finally:
            writer.close()
