"""What a look at a device finds, and the hook by which a driver adds its own looks to `slipguard doctor`.

A driver may have a method

    def diagnose(self, *, owned: bool) -> AsyncIterator[Finding]

that looks at what only it knows of: files, permissions, cables, adapters, controllers. It is called before `open()`.
owned: a running daemon has the device open, so look from outside only. It never moves anything, never raises what a
user could cause, and ends within a few seconds. What the port can tell (frames, round trips, states) the doctor looks
at itself.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncIterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable


class Verdict(StrEnum):
    """fine: as it should be. note: it works, but somebody should know. wrong: it does not work."""

    FINE = "fine"
    NOTE = "note"
    WRONG = "wrong"


@dataclass(frozen=True, slots=True)
class Finding:
    """One line. what: in two or three words. do: how to mend it; never empty where something is wrong."""

    what: str
    verdict: Verdict
    seen: str
    do: str = ""


def fine(what: str, seen: str) -> Finding:
    """As it should be."""
    return Finding(what, Verdict.FINE, seen)


def note(what: str, seen: str, do: str = "") -> Finding:
    """It works, but somebody should know."""
    return Finding(what, Verdict.NOTE, seen, do)


def wrong(what: str, seen: str, do: str) -> Finding:
    """It does not work. do: the next step of whoever reads it."""
    return Finding(what, Verdict.WRONG, seen, do)


@runtime_checkable
class Diagnosable(Protocol):
    """A driver that adds looks of its own."""

    @abstractmethod
    def diagnose(self, *, owned: bool) -> AsyncIterator[Finding]:
        """Look without moving anything; see the module."""


def from_error(what: str, error: Exception, device: str, otherwise: str) -> Finding:
    """A finding from one of our one-line errors: what was seen before the last `; `, what to do behind it.

    device: left out of the line where it leads it. otherwise: what to do where the error does not say.
    """
    text = str(error).removeprefix(f"{device}: ")
    seen, found, do = text.rpartition("; ")
    return wrong(what, seen if found else text, do if found else otherwise)
