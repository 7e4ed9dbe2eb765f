"""The port of an emulator: a device's double on the wire, for `slipguard emulate`.

An emulator registers under the entry-point group `slipguard.emulator`. The registered class has `Settings` (a pydantic
model whose fields, each with a description and a default, become the command's options), a docstring that is the
command's help, and is built as `Emulator(settings, report)`; building opens nothing, `start()` does.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Mapping
from typing import Protocol

Event = Mapping[str, object]
"""What really happened: `event` (a word), `at_s` (the event loop's clock) and whatever belongs to it; fit for JSON."""
Report = Callable[[Event], None]


class Emulator(Protocol):
    """One double. Tests and cells build it directly; the command line is only one more user."""

    @property
    @abstractmethod
    def address(self) -> str:
        """Where clients find it: a path, or host and port. Known after `start()`."""

    @abstractmethod
    async def start(self) -> None:
        """Appear on the wire. Raises InputError where that is not possible."""

    @abstractmethod
    async def stop(self) -> None:
        """Vanish. Never raises; idempotent."""

    @abstractmethod
    def control(self, words: str) -> str:
        """Obey one line of control words and answer it in one or more lines.

        All emulators know `fault NAME [probability|count]`, `clear [NAME]`, `state`, `log [LINES]` and `help`.
        Raises CommandRefused with what is allowed.
        """

    @abstractmethod
    def state(self) -> Mapping[str, object]:
        """The truth now, as one row of a table; fit for JSON."""
