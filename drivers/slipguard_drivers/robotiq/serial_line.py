"""One serial port, opened and closed in a thread, so that a wedged adapter cannot stop the event loop.

To open or close the port of a USB adapter, the kernel talks to the adapter. One that no longer answers blocks that for
5 s per request, and for up to 30 s if bytes are unsent. Reading and writing only use the kernel's buffers: the port is
non-blocking. A blocked open or close keeps its thread until the kernel gives up; meanwhile no second one is started.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import termios
import threading
import tty
from collections.abc import Callable
from typing import TypeVar

from slipguard_drivers.robotiq import serial_port

T = TypeVar("T")
A = TypeVar("A")
BLOCKED_S = 1.0
"""An adapter that takes longer to open or to close its port is wedged; a good one takes some milliseconds."""
READ_BYTES = 4096


class PortBlockedError(OSError):
    """The adapter does not answer the kernel."""


class SerialLine:
    """A serial port at 115200 baud, 8N1, for exclusive use.

    on_bytes: called with all received bytes. on_lost: called when the port has disappeared; it is closed then.
    """

    def __init__(self, port: str, on_bytes: Callable[[bytes], None], on_lost: Callable[[], None]) -> None:
        self._port = port
        self._on_bytes = on_bytes
        self._on_lost = on_lost
        self._fd: int | None = None
        self._blocking: asyncio.Future[object] | None = None
        """The open or close that is under way, or the last one."""

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._fd is not None

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
        self._fd = opening.result()
        asyncio.get_running_loop().add_reader(self._fd, self.receive)

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
        fd, self._fd = self._fd, None
        if fd is not None:
            asyncio.get_running_loop().remove_reader(fd)
            self._start(close_port, fd)

    def write(self, data: bytes) -> None:
        """Send bytes. Raises OSError if the port is closed, or if the adapter takes no bytes."""
        if self._fd is None or os.write(self._fd, data) != len(data):
            raise OSError("the port is closed or its buffer is full")

    def receive(self) -> None:
        """Pass on the bytes that have arrived; to be called before a decision that depends on a silent line."""
        if self._fd is None:
            return
        try:
            data = os.read(self._fd, READ_BYTES)
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

    def _close_late(self, opening: asyncio.Future[int]) -> None:
        """Close a port that was opened after it had been given up."""
        if opening.exception() is None:
            self._start(close_port, opening.result())


def open_port(port: str) -> int:
    """Open a port for exclusive use and set it up; return its file descriptor. Blocks; raises OSError."""
    fd = os.open(port, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        fcntl.flock(fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        tty.setraw(fd, termios.TCSANOW)
        iflag, oflag, cflag, lflag, _, _, characters = termios.tcgetattr(fd)
        cflag |= termios.CLOCAL | termios.CREAD
        cflag &= ~(termios.CSTOPB | termios.CRTSCTS)
        iflag &= ~(termios.IXOFF | termios.IXANY)
        speed = termios.B115200
        termios.tcsetattr(fd, termios.TCSANOW, [iflag, oflag, cflag, lflag, speed, speed, characters])
        serial_port.lock_out_others(fd)
        serial_port.request_low_latency(fd)
        termios.tcflush(fd, termios.TCIOFLUSH)
    except BaseException as error:
        os.close(fd)
        if isinstance(error, termios.error):  # no subclass of OSError
            raise OSError(*error.args) from None
        raise
    return fd


def close_port(fd: int) -> None:
    """Close a port, without waiting for bytes that are still to be sent. Blocks if the adapter does not answer."""
    with contextlib.suppress(OSError, termios.error):
        termios.tcflush(fd, termios.TCOFLUSH)
    with contextlib.suppress(OSError):
        os.close(fd)
