"""Accepts TCP connections, and finds out whose they are before they cost anything.

Any user of this machine may open hundreds of connections to the port. Until a request's headers are complete, a
connection is a socket and what it has sent, nothing more. Then a request with the token or the page's cookie is handled
at once; all others wait for each other, and have few places.
"""

from __future__ import annotations

import asyncio
import contextlib
import re
import socket
from collections import OrderedDict
from collections.abc import Callable
from functools import partial

from slipguard.web import connections
from slipguard.web.connections import HEADERS_MAX_BYTES, TOO_MANY, BoundedHttpProtocol, ReceiveQueue

BACKLOG = 1024
"""Connections that the kernel keeps until they are accepted; beyond that, a client would wait for a second."""
ACCEPTED_MAX = 16
"""Connections that one cycle of the event loop accepts, some 30 µs each."""
WAITING_MAX = 1024
"""Connections without complete headers. One more closes the oldest: a client that knows the token sends it at once."""
QUEUED_MAX = 512
"""Requests of unknown clients that wait for each other; one more is refused."""
RETRY_S = 0.2
"""Pause after the system has refused a descriptor."""
HEADERS_END = re.compile(rb"\n\r?\n")

MakeProtocol = Callable[..., BoundedHttpProtocol]
"""Makes the protocol of a connection from `received` and `receive_queue`, as `BoundedHttpProtocol` takes them."""


class Acceptor:
    """Accepts the connections of one listening socket until closed.

    Args:
        listening: Not blocking.
        is_known: Whether headers, up to the empty line, show a client that may send commands.
        make_protocol: See `MakeProtocol`.
    """

    def __init__(
        self, listening: socket.socket, is_known: Callable[[bytes], bool], make_protocol: MakeProtocol
    ) -> None:
        self._listening, self._is_known, self._make_protocol = listening, is_known, make_protocol
        self._loop = asyncio.get_running_loop()
        self._waiting: OrderedDict[socket.socket, tuple[bytearray, float]] = OrderedDict()
        self._queue = ReceiveQueue()
        self._queued: set[socket.socket] = set()
        self._tasks: set[asyncio.Task[object]] = set()
        self._timer = self._loop.call_later(1.0, self._close_expired)
        listening.listen(BACKLOG)
        self._loop.add_reader(listening, self._accept)

    def close(self) -> None:
        """Stop accepting, and close the connections that nothing was answered on yet."""
        self._timer.cancel()
        self._loop.remove_reader(self._listening)
        self._listening.close()
        while self._waiting:
            self._close_oldest()
        while self._queued:
            self._queued.pop().close()

    def _accept(self) -> None:
        for _ in range(ACCEPTED_MAX):
            try:
                connection, _ = self._listening.accept()
            except (BlockingIOError, InterruptedError, ConnectionAbortedError):
                return
            except OSError:  # no descriptor or memory is left
                self._loop.remove_reader(self._listening)
                self._loop.call_later(RETRY_S, self._accept_again)
                return
            connection.setblocking(False)
            if len(self._waiting) >= WAITING_MAX:
                self._close_oldest()
            self._waiting[connection] = (bytearray(), self._loop.time())
            self._loop.add_reader(connection, self._receive, connection)

    def _accept_again(self) -> None:
        if self._listening.fileno() >= 0:
            self._loop.add_reader(self._listening, self._accept)

    def _receive(self, connection: socket.socket) -> None:
        received, _ = self._waiting[connection]
        try:
            data = connection.recv(HEADERS_MAX_BYTES)
        except (BlockingIOError, InterruptedError):
            return
        except OSError:
            data = b""
        end = HEADERS_END.search(received + data, max(len(received) - 2, 0))
        received += data
        if not data:
            self._forget(connection)
            connection.close()
        elif end is not None or len(received) > HEADERS_MAX_BYTES:
            self._forget(connection)
            if end is not None and self._is_known(bytes(received[: end.end()])):
                self._serve(connection, bytes(received), None)
            elif len(self._queued) >= QUEUED_MAX:
                with contextlib.suppress(OSError):
                    connection.send(TOO_MANY)
                connection.close()
            else:
                self._queued.add(connection)
                self._queue.add(self._loop, partial(self._serve_queued, connection, bytes(received)))

    def _serve_queued(self, connection: socket.socket, received: bytes) -> None:
        if connection in self._queued:  # else closed
            self._queued.remove(connection)
            self._serve(connection, received, self._queue)

    def _serve(self, connection: socket.socket, received: bytes, queue: ReceiveQueue | None) -> None:
        protocol = partial(self._make_protocol, received=received, receive_queue=queue)
        task = self._loop.create_task(self._loop.connect_accepted_socket(protocol, connection), name="web: accept")
        self._tasks.add(task)
        task.add_done_callback(self._served)

    def _served(self, task: asyncio.Task[object]) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()  # the client has gone meanwhile

    def _forget(self, connection: socket.socket) -> None:
        del self._waiting[connection]
        self._loop.remove_reader(connection)

    def _close_oldest(self) -> None:
        connection = next(iter(self._waiting))
        self._forget(connection)
        connection.close()

    def _close_expired(self) -> None:
        limit_s = self._loop.time() - connections.REQUEST_TIMEOUT_S
        while self._waiting and next(iter(self._waiting.values()))[1] < limit_s:
            self._close_oldest()
        self._timer = self._loop.call_later(1.0, self._close_expired)
