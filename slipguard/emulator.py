"""The port of an emulator: an emulated device on the wire, for `slipguard emulate`.

An emulator registers under the entry-point group `slipguard.emulator`. The registered class has `Settings` (a pydantic
model whose fields, each with a description and a default, become the command's options) and a docstring that is the
command's help. It is built as `Emulator(settings, report)`; building opens nothing, `start()` does.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Protocol

Event = Mapping[str, object]
"""Something that happened: `event` (its name), `at_s` (the event loop's clock) and details; fit for JSON."""
Report = Callable[[Event], None]


class Emulator(Protocol):
    """One emulated device. Tests and emulated cells build it directly; the command line is only one more user."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Where clients connect: a path, or host and port. Known after `start()`."""

    @abstractmethod
    async def start(self) -> None:
        """Become available on the wire. Raises InputError if that is not possible."""

    @abstractmethod
    async def stop(self) -> None:
        """Disappear. Never raises; idempotent."""

    @abstractmethod
    def control(self, line: str) -> str:
        """Execute one command line and return its response of one or more lines.

        All emulators have the commands `fault NAME [probability|count]`, `clear [NAME]`, `state`, `log [LINES]` and
        `help`. Raises CommandRefused with what is allowed.
        """

    @abstractmethod
    def state(self) -> Mapping[str, object]:
        """Return the true state, as one row of a table; fit for JSON."""
