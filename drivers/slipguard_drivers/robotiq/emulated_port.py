"""A serial port that is not there: a pseudo terminal behind a name that stays, as udev's by-id names do."""

from __future__ import annotations

import asyncio
import contextlib
import os
import pty
import tty
from collections.abc import Callable
from pathlib import Path

from slipguard.errors import InputError


class EmulatedPort:
    """The device's end. on_bytes: called with what the client wrote.

    link: the name clients use; without one they use the pseudo terminal's own, which a new plug changes.
    """

    def __init__(self, link: Path | None, on_bytes: Callable[[bytes], None]) -> None:
        self._link = link
        self._on_bytes = on_bytes
        self._fds: tuple[int, int] | None = None
        self._name = ""

    @property
    def path(self) -> str:
        """What a client opens."""
        return str(self._link) if self._link is not None else self._name

    @property
    def plugged(self) -> bool:
        """Whether it is there."""
        return self._fds is not None

    def plug(self) -> None:
        """Appear. Idempotent. Raises InputError where something else has the name."""
        if self._fds is not None:
            return
        if self._link is not None and self._link.exists() and not self._link.is_symlink():
            raise InputError(f"{self._link} exists and is no link; name a path that is free")
        ours, theirs = pty.openpty()
        # The client's end stays open here as well: with nobody there the loop would be woken without end.
        tty.setraw(ours)
        tty.setraw(theirs)
        os.set_blocking(ours, False)
        self._fds, self._name = (ours, theirs), os.ttyname(theirs)
        try:
            self._make_link()
        except OSError as error:
            self.unplug()
            raise InputError(f"{self._link} cannot be made: {error.strerror}") from None
        asyncio.get_running_loop().add_reader(ours, self._read)

    def unplug(self) -> None:
        """Vanish, as an adapter pulled out does. Idempotent."""
        if self._fds is None:
            return
        fds, self._fds = self._fds, None
        asyncio.get_running_loop().remove_reader(fds[0])
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self._name:
            self._link.unlink()
        for fd in fds:
            os.close(fd)

    def send(self, data: bytes) -> None:
        """Hand bytes to the client; lost where there is none, or one that does not read."""
        if self._fds is not None:
            with contextlib.suppress(OSError):
                os.write(self._fds[0], data)

    def _make_link(self) -> None:
        if self._link is not None:
            new = self._link.with_name(f".{self._link.name}.{os.getpid()}")
            new.symlink_to(self._name)
            new.replace(self._link)

    def _read(self) -> None:
        if self._fds is not None:
            with contextlib.suppress(OSError):
                self._on_bytes(os.read(self._fds[0], 4096))
