"""One serial port or TCP connection, opened and closed in a thread, so that it cannot stop the event loop.

To open or close the port of a USB adapter, the kernel talks to the adapter. One that no longer answers blocks that for
5 s per request, and for up to 30 s if bytes are unsent; a host that is off blocks a connection for longer. Reading and
writing only use the kernel's buffers: the port is non-blocking. A blocked open or close keeps its thread until the
kernel gives up; meanwhile no second one is started.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import socket
import termios
import threading
from collections.abc import Callable
from typing import TypeVar
from urllib.parse import urlsplit

import serial

from slipguard_drivers.robotiq import serial_port

T = TypeVar("T")
A = TypeVar("A")
BLOCKED_S = 1.0
"""An adapter that takes longer to open or to close its port is wedged; a good one takes some milliseconds."""
BAUD = 115200
READ_BYTES = 4096
TCP = "socket://"
"""Prefix of a port that is a TCP connection, as pyserial has it."""
CONNECT_S = 0.9
"""A connection that takes longer is given up, just before the line counts as blocked."""


class PortBlockedError(OSError):
    """The adapter does not answer the kernel."""


class ByteLine:
    """A serial port at 115200 baud, 8N1, for exclusive use, or a TCP connection.

    port: a device file, or `socket://HOST:PORT`.

    on_bytes: called with all received bytes. on_lost: called when the port has disappeared; it is closed then.
    """

    def __init__(self, port: str, on_bytes: Callable[[bytes], None], on_lost: Callable[[], None]) -> None:
        self._port = port
        self._on_bytes = on_bytes
        self._on_lost = on_lost
        self._open_port: serial.Serial | socket.socket | None = None
        self._blocking: asyncio.Future[object] | None = None
        """The open or close that is under way, or the last one."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._open_port is not None

    async def open(self) -> None:
        """Open the port. Raises OSError if that fails, PortBlockedError if the adapter does not answer."""
        if not await self.settled():
            raise PortBlockedError
        opening = self._start(open_port, self._port)
        try:
            await asyncio.wait([opening], timeout=BLOCKED_S)
        except asyncio.CancelledError:
            opening.add_done_callback(self._close_late)
            raise
        if not opening.done():
            opening.add_done_callback(self._close_late)
            raise PortBlockedError
        self._open_port = opening.result()
        asyncio.get_running_loop().add_reader(self._open_port.fileno(), self.receive)

    async def settled(self) -> bool:
        """Wait until the port is neither being opened nor closed; return False if the adapter blocks that."""
        loop = asyncio.get_running_loop()
        ends_s = loop.time() + BLOCKED_S
        while self._blocking is not None and not self._blocking.done():
            if loop.time() >= ends_s:
                return False
            await asyncio.wait([self._blocking], timeout=ends_s - loop.time())
        return True

    def close(self) -> None:
        """Begin to close the port; no byte is received any more. Idempotent."""
        closing, self._open_port = self._open_port, None
        if closing is not None:
            asyncio.get_running_loop().remove_reader(closing.fileno())
            self._start(close_port, closing)

    def write(self, data: bytes) -> None:
        """Send bytes. Raises OSError if the port is closed, or if the adapter takes no bytes."""
        if self._open_port is None or os.write(self._open_port.fileno(), data) != len(data):
            raise OSError("the port is closed or its buffer is full")

    def receive(self) -> None:
        """Pass on the bytes that have arrived; to be called before a decision that depends on a silent line."""
        if self._open_port is None:
            return
        try:
            data = os.read(self._open_port.fileno(), READ_BYTES)
        except BlockingIOError:
            return
        except OSError:
            data = b""
        if data:
            self._on_bytes(data)
        else:  # unplugged
            self.close()
            self._on_lost()

    def _start(self, job: Callable[[A], T], argument: A) -> asyncio.Future[T]:
        """Start a call that may block, in a thread that does not delay the end of the process."""
        loop = asyncio.get_running_loop()
        future: asyncio.Future[T] = loop.create_future()
        future.add_done_callback(lambda done: done.cancelled() or done.exception())  # mark it as read
        self._blocking = future  # type: ignore[assignment]

        def deliver(result: T | None, error: Exception | None) -> None:
            if error is not None:
                future.set_exception(error)
            else:
                future.set_result(result)  # type: ignore[arg-type]

        def run() -> None:
            result, failed = None, None
            try:
                result = job(argument)
            except Exception as error:
                failed = error
            with contextlib.suppress(RuntimeError):  # the loop has ended
                loop.call_soon_threadsafe(deliver, result, failed)

        threading.Thread(target=run, name=f"port {self._port}", daemon=True).start()
        return future

    def _close_late(self, opening: asyncio.Future[serial.Serial | socket.socket]) -> None:
        """Close a port that was opened after it had been given up."""
        if opening.exception() is None:
            self._start(close_port, opening.result())


def is_tcp(port: str) -> bool:
    """Return whether a port is a TCP connection."""
    return port.startswith(TCP)


def host_and_port(text: str) -> tuple[str, int]:
    """Split `HOST:PORT`, with or without `socket://`. Raises ValueError with what is wrong."""
    parts = urlsplit(text if is_tcp(text) else TCP + text)
    number = parts.port  # ValueError if it is none
    if not parts.hostname or number is None or parts.path or parts.query or parts.username:
        raise ValueError(f"{text!r} is not HOST:PORT, such as 192.168.1.10:54321")
    return parts.hostname, number


def open_port(port: str) -> serial.Serial | socket.socket:
    """Open a port, non-blocking. Blocks if adapter or host do not answer; raises OSError."""
    return _connect(*host_and_port(port)) if is_tcp(port) else _open_serial(port)


def _connect(host: str, port: int) -> socket.socket:
    connection = socket.create_connection((host, port), CONNECT_S)
    connection.setblocking(False)
    connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    return connection


def _open_serial(port: str) -> serial.Serial:
    """Open a serial port for exclusive use."""
    try:
        # inter_byte_timeout: VMIN becomes 1, so that a read without bytes differs from a read of a lost port.
        opened = serial.Serial(port, BAUD, timeout=0, inter_byte_timeout=0, exclusive=True)
    except termios.error as error:  # the adapter went while it was set up; no subclass of OSError
        raise OSError(*error.args) from None
    serial_port.lock_out_others(opened.fileno())
    serial_port.request_low_latency(opened.fileno())
    return opened


def close_port(port: serial.Serial | socket.socket) -> None:
    """Close a port, without waiting for bytes that are still to be sent. Blocks if the adapter does not answer."""
    if isinstance(port, serial.Serial):
        with contextlib.suppress(OSError, termios.error):
            port.reset_output_buffer()
    with contextlib.suppress(OSError):
        port.close()
