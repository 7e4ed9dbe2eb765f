"""An emulated serial port: a pseudo terminal behind a permanent name, like udev's by-id names."""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import os
import pty
import select
import termios
import tty
from collections.abc import Callable
from pathlib import Path

from slipguard.errors import InputError

POLL_S = 0.01
"""How often to check for a client; a terminal without client would wake the loop permanently."""


class EmulatedPort:
    """The device's end. on_bytes: called with the bytes that the client wrote.

    link: the name for clients; without one they use the pseudo terminal's name, which changes with each `plug`.
    """

    def __init__(self, link: Path | None, on_bytes: Callable[[bytes], None]) -> None:
        self._link = link
        self._on_bytes = on_bytes
        self.plugs = 0
        """How often the port was created."""
        self._fd: int | None = None
        self._name = ""
        self._look: asyncio.TimerHandle | None = None

    @property
    def path(self) -> str:
        """The path for clients."""
        return str(self._link) if self._link is not None else self._name

    @property
    def plugged(self) -> bool:
        """Whether the port exists."""
        return self._fd is not None

    def plug(self) -> None:
        """Create the port. Idempotent. Raises InputError if the name is in use."""
        if self._fd is not None:
            return
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise InputError(f"{self._link} exists and is not a link; name an unused path")
        self.plugs += 1
        self._fd, theirs = pty.openpty()
        self._name = os.ttyname(theirs)
        tty.setraw(theirs)
        os.close(theirs)  # if kept open, it would keep a client's settings and unread bytes
        os.set_blocking(self._fd, False)
        try:
            self._make_link()
        except OSError as error:
            self.unplug()
            raise InputError(f"{self._link} cannot be created: {error.strerror}; name another path") from None
        self._wait_for_a_client()

    def unplug(self) -> None:
        """Remove the port, like an unplugged adapter. Idempotent."""
        if self._fd is None:
            return
        if self._look is not None:
            self._look.cancel()
            self._look = None
        fd, self._fd = self._fd, None
        asyncio.get_running_loop().remove_reader(fd)
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        os.close(fd)

    def send(self, data: bytes, plug: int) -> None:
        """Send bytes to the client; they are lost if there is no client, or if it does not read.

        plug: the value of `plugs` at the request; bytes that were on their way when the port disappeared are lost.
        """
        if self._fd is not None and plug == self.plugs and not self._is_hung_up():
            with contextlib.suppress(OSError):
                os.write(self._fd, data)

    def _make_link(self) -> None:
        if self._link is not None:
            new = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            new.symlink_to(self._name)
            new.replace(self._link)

    def _is_hung_up(self) -> bool:
        poll = select.poll()
        poll.register(self._fd or 0, 0)
        return bool(poll.poll(0))

    def _wait_for_a_client(self) -> None:
        loop = asyncio.get_running_loop()
        if self._fd is None:
            return
        if self._is_hung_up():
            self._look = loop.call_later(POLL_S, self._wait_for_a_client)
        else:
            self._look = None
            loop.add_reader(self._fd, self._read)

    def _closed(self) -> None:
        """Discard unread bytes and exclusive use, as a real port does at its last close."""
        try:
            theirs = os.open(self._name, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError:  # only root may open a claimed terminal, so create a new one behind the name
            self.unplug()
            self.plug()
            return
        with contextlib.suppress(OSError):
            termios.tcflush(theirs, termios.TCIOFLUSH)
            fcntl.ioctl(theirs, termios.TIOCNXCL)
        os.close(theirs)
        self._wait_for_a_client()

    def _read(self) -> None:
        if self._fd is None:
            return
        try:
            data = os.read(self._fd, 4096)
        except BlockingIOError:
            return
        except OSError:  # the client has disconnected
            asyncio.get_running_loop().remove_reader(self._fd)
            self._closed()
            return
        self._on_bytes(data)
