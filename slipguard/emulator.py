"""Interface of an emulator: a simulated device that speaks the real device's protocol, for `slipguard emulate`.

An emulator registers under the entry-point group `slipguard.emulator`. The registered class has `Settings` (a pydantic
model whose fields, each with a description and a default, become the command's options), a docstring that is the
command's help, and is built as `Emulator(settings, report)`; `start()` opens it.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Protocol

Event = Mapping[str, object]
"""What happened: `event` (a word), `at_s` (the event loop's clock) and further values; can be written as JSON."""
Report = Callable[[Event], None]


class Emulator(Protocol):
    """One emulated device; also built directly by tests and by the emulated cell."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Address for clients: a path, or host and port. Known after `start()`."""

    @abstractmethod
    async def start(self) -> None:
        """Start to serve clients. Raises InputError if that is not possible."""

    @abstractmethod
    async def stop(self) -> None:
        """Stop to serve clients. Never raises; idempotent."""

    @abstractmethod
    def control(self, words: str) -> str:
        """Carry out one command line and return one or more lines.

        All emulators support `fault NAME [probability|count]`, `clear [NAME]`, `state`, `log [LINES]` and `help`.
        Raises CommandRefused with what is allowed.
        """

    @abstractmethod
    def state(self) -> Mapping[str, object]:
        """Return the true state, as one row of a table; can be written as JSON."""
