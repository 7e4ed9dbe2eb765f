"""What all emulators have in common: faults on demand, a log of events, and commands for both."""

from __future__ import annotations

import asyncio
import json
import random
from abc import abstractmethod
from collections import deque
from collections.abc import Callable, Mapping

from slipguard.emulator import Emulator, Event, Report
from slipguard.errors import CommandRefused

LOG_EVENTS = 10_000
"""How many of the newest events are kept; `report` receives all of them."""

EmulatorCommand = tuple[Callable[[list[str]], str], str]
"""A function of the words after the command's name, and its line of help."""


class FaultPlan:
    """Which faults occur, and when. kinds: descriptions by name.

    A fault occurs at every opportunity until it is cleared, with a probability, or a number of times.
    """

    def __init__(self, kinds: Mapping[str, str], seed: int = 0) -> None:
        self.kinds = kinds
        self._rng = random.Random(seed)
        self._amounts: dict[str, float | int | None] = {}
        self.occurred: dict[str, int] = dict.fromkeys(kinds, 0)
        """How often each has occurred."""

    def set(self, name: str, amount: float | int | None = None) -> None:
        """Start a fault: at every opportunity (None), with a probability (float), or a number of times (int).

        Raises CommandRefused for an unknown name or an invalid amount.
        """
        self.check(name)
        if isinstance(amount, float) and not 0.0 <= amount <= 1.0:
            raise CommandRefused(f"{amount} is not a probability; it must be 0 to 1 (a count has no decimal point)")
        if isinstance(amount, int) and amount < 1:
            raise CommandRefused(f"{amount} is not a count; give at least 1, or `clear {name}`")
        self._amounts[name] = amount

    def clear(self, name: str | None = None) -> None:
        """End one fault, or all. Raises CommandRefused for an unknown name."""
        if name is None:
            self._amounts.clear()
        else:
            self.check(name)
            self._amounts.pop(name, None)

    def occurs(self, name: str) -> bool:
        """Return whether the fault occurs now; call it once per opportunity."""
        if name not in self._amounts:
            return False
        amount = self._amounts[name]
        if isinstance(amount, float) and self._rng.random() >= amount:
            return False
        if isinstance(amount, int):
            self._amounts[name] = amount - 1
            if amount == 1:
                del self._amounts[name]
        self.occurred[name] += 1
        return True

    def lasts(self, name: str) -> bool:
        """Return whether the fault was set until cleared; this call is not an opportunity."""
        return self._amounts.get(name, 0) is None

    @property
    def active(self) -> dict[str, str]:
        """Return the faults that may occur, each with how often, as text."""
        return {name: _how_often(amount) for name, amount in self._amounts.items()}

    def check(self, name: str) -> None:
        """Raise CommandRefused for an unknown name."""
        if name not in self.kinds:
            raise CommandRefused(f"no fault {name!r}; the faults are: {', '.join(self.kinds)}")


class ControlledEmulator(Emulator):
    """An emulator with a fault plan, a log, and commands for both; subclasses add their own with `commands`.

    report: called with every event.
    """

    def __init__(self, kinds: Mapping[str, str], seed: int = 0, report: Report | None = None) -> None:
        self.faults = FaultPlan(kinds, seed)
        self.log: deque[Event] = deque(maxlen=LOG_EVENTS)
        self._report = report

    def note(self, event: str, **details: object) -> None:
        """Log an event."""
        entry = {"at_s": round(asyncio.get_running_loop().time(), 6), "event": event, **details}
        self.log.append(entry)
        if self._report is not None:
            self._report(entry)

    def events(self, name: str) -> list[Event]:
        """Return the logged events of one name, oldest first."""
        return [entry for entry in self.log if entry["event"] == name]

    def control(self, line: str) -> str:
        """Execute one command line; see `Emulator.control`."""
        name, *rest = line.split() or [""]
        command = self._all_commands().get(name)
        if command is None:
            raise CommandRefused(f"no command {name!r}; the commands are: {', '.join(self._all_commands())}")
        return command[0](rest)

    @abstractmethod
    def commands(self) -> dict[str, EmulatorCommand]:
        """Return the commands that only this emulator has."""

    def set_fault(self, name: str, amount: float | int | None = None) -> None:
        """Start a fault, see `FaultPlan.set`; some take effect at once."""
        self.faults.set(name, amount)
        self.fault_changed()

    def clear_fault(self, name: str | None = None) -> None:
        """End faults, see `FaultPlan.clear`."""
        self.faults.clear(name)
        self.fault_changed()

    def fault_changed(self) -> None:
        """React to a fault that was set or cleared; for those that take effect at once."""
        return

    def _all_commands(self) -> dict[str, EmulatorCommand]:
        return {
            "fault": (self._fault, "fault NAME [probability|count]: " + ", ".join(self.faults.kinds)),
            "clear": (self._clear, "clear [NAME]: end one fault, or all"),
            **self.commands(),
            "state": (lambda rest: json.dumps(dict(self.state())), "state: the true state"),
            "log": (self._log, "log [LINES]: the newest events"),
            "help": (lambda rest: "\n".join(text for _, text in self._all_commands().values()), "help: these lines"),
        }

    def _fault(self, rest: list[str]) -> str:
        if not rest or len(rest) > 2:
            return "\n".join(f"{name}: {text}" for name, text in self.faults.kinds.items())
        amount = _amount(rest[1]) if len(rest) == 2 else None
        self.set_fault(rest[0], amount)
        return f"{rest[0]}: {_how_often(amount)}"

    def _clear(self, rest: list[str]) -> str:
        self.clear_fault(rest[0] if rest else None)
        return f"cleared {rest[0] if rest else 'all faults'}"

    def _log(self, rest: list[str]) -> str:
        if rest and not rest[0].isdecimal():
            raise CommandRefused(f"{rest[0]!r} is not a number of lines")
        count = int(rest[0]) if rest else 10
        newest = list(self.log)[max(0, len(self.log) - count) :]
        return "\n".join(json.dumps(dict(entry)) for entry in newest) or "no events yet"


def _amount(text: str) -> float | int:
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError:
        raise CommandRefused(f"{text!r} is neither a probability (0.01) nor a count (3)") from None


def _how_often(amount: float | int | None) -> str:
    if amount is None:
        return "until cleared"
    return f"{amount:g} of the time" if isinstance(amount, float) else f"{amount} times more"
