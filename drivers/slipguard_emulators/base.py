"""What all emulators have in common: faults on demand, a log of the truth, and one language to control both."""

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
"""The newest so many events are kept; whoever wants all of them listens."""

EmulatorCommand = tuple[Callable[[list[str]], str], str]
"""What to do with the words behind it, and its line of help."""


class FaultPlan:
    """Which faults strike, and when. kinds: name -> what it does, in words.

    A fault strikes always until cleared, with a probability at each opportunity, or the next so many times.
    """

    def __init__(self, kinds: Mapping[str, str], seed: int = 0) -> None:
        self.kinds = kinds
        self._rng = random.Random(seed)
        self._amounts: dict[str, float | int | None] = {}
        self.struck: dict[str, int] = dict.fromkeys(kinds, 0)
        """How often each has struck."""

    def set(self, name: str, amount: float | int | None = None) -> None:
        """From now on `name` strikes: always (None), with a probability (float), or so many times (int).

        Raises CommandRefused for an unknown name or a senseless amount.
        """
        self.check(name)
        if isinstance(amount, float) and not 0.0 <= amount <= 1.0:
            raise CommandRefused(f"{amount} is no probability; it must be 0 to 1 (a count has no decimal point)")
        if isinstance(amount, int) and amount < 1:
            raise CommandRefused(f"{amount} times makes no sense; give a count of at least 1, or `clear {name}`")
        self._amounts[name] = amount

    def clear(self, name: str | None = None) -> None:
        """End one fault, or all. Raises CommandRefused for an unknown name."""
        if name is None:
            self._amounts.clear()
        else:
            self.check(name)
            self._amounts.pop(name, None)

    def strikes(self, name: str) -> bool:
        """Ask once per opportunity whether the fault strikes now."""
        if name not in self._amounts:
            return False
        amount = self._amounts[name]
        if isinstance(amount, float) and self._rng.random() >= amount:
            return False
        if isinstance(amount, int):
            self._amounts[name] = amount - 1
            if amount == 1:
                del self._amounts[name]
        self.struck[name] += 1
        return True

    def lasts(self, name: str) -> bool:
        """Whether the fault was set until cleared; asking is no opportunity."""
        return self._amounts.get(name, 0) is None

    @property
    def active(self) -> dict[str, str]:
        """The faults that may strike, each with how often, in words."""
        return {name: _how_often(amount) for name, amount in self._amounts.items()}

    def check(self, name: str) -> None:
        """Raise CommandRefused for an unknown name."""
        if name not in self.kinds:
            raise CommandRefused(f"no fault {name!r}; there are: {', '.join(self.kinds)}")


class ControlledEmulator(Emulator):
    """An emulator with a fault plan, a log, and the words for them; subclasses add their own with `words`.

    report: called with every event as it happens.
    """

    def __init__(self, kinds: Mapping[str, str], seed: int = 0, report: Report | None = None) -> None:
        self.faults = FaultPlan(kinds, seed)
        self.log: deque[Event] = deque(maxlen=LOG_EVENTS)
        self._report = report

    def note(self, event: str, **details: object) -> None:
        """Log what has really happened now."""
        entry = {"at_s": round(asyncio.get_running_loop().time(), 6), "event": event, **details}
        self.log.append(entry)
        if self._report is not None:
            self._report(entry)

    def events(self, name: str) -> list[Event]:
        """The logged events of one name, oldest first."""
        return [entry for entry in self.log if entry["event"] == name]

    def control(self, words: str) -> str:
        """Obey one line; see `Emulator.control`."""
        name, *rest = words.split() or [""]
        word = self._words().get(name)
        if word is None:
            raise CommandRefused(f"no word {name!r}; there are: {', '.join(self._words())}")
        return word[0](rest)

    @abstractmethod
    def words(self) -> dict[str, EmulatorCommand]:
        """The words that only this emulator knows."""

    def set_fault(self, name: str, amount: float | int | None = None) -> None:
        """See `FaultPlan.set`; acts at once where the fault does."""
        self.faults.set(name, amount)
        self.fault_changed()

    def clear_fault(self, name: str | None = None) -> None:
        """See `FaultPlan.clear`."""
        self.faults.clear(name)
        self.fault_changed()

    def fault_changed(self) -> None:
        """Called after a fault was set or cleared; for those that act at once."""
        return

    def _words(self) -> dict[str, EmulatorCommand]:
        return {
            "fault": (self._fault, "fault NAME [probability|count]: " + ", ".join(self.faults.kinds)),
            "clear": (self._clear, "clear [NAME]: end one fault, or all"),
            **self.words(),
            "state": (lambda rest: json.dumps(dict(self.state())), "state: the truth now"),
            "log": (self._log, "log [LINES]: the newest events"),
            "help": (lambda rest: "\n".join(text for _, text in self._words().values()), "help: these lines"),
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
            raise CommandRefused(f"{rest[0]!r} is no number of lines")
        count = int(rest[0]) if rest else 10
        newest = list(self.log)[max(0, len(self.log) - count) :]
        return "\n".join(json.dumps(dict(entry)) for entry in newest) or "nothing has happened yet"


def _amount(text: str) -> float | int:
    try:
        return int(text) if text.isdecimal() else float(text)
    except ValueError:
        raise CommandRefused(f"{text!r} is neither a probability (0.01) nor a count (3)") from None


def _how_often(amount: float | int | None) -> str:
    if amount is None:
        return "until cleared"
    return f"{amount:g} of the time" if isinstance(amount, float) else f"{amount} times more"
