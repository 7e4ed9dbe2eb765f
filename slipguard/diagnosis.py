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


class CheckStatus(StrEnum):
    """fine: as it should be. note: it works, but somebody should know. wrong: it does not work."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """One line. what: in two or three words. do: how to mend it; never empty where something is wrong."""

    check: str
    status: CheckStatus
    observed: str
    action: str = ""


def ok(check: str, observed: str) -> CheckResult:
    """As it should be."""
    return CheckResult(check, CheckStatus.OK, observed)


def note(check: str, observed: str, action: str = "") -> CheckResult:
    """It works, but somebody should know."""
    return CheckResult(check, CheckStatus.NOTE, observed, action)


def problem(check: str, observed: str, action: str) -> CheckResult:
    """It does not work. do: the next step of whoever reads it."""
    return CheckResult(check, CheckStatus.PROBLEM, observed, action)


@runtime_checkable
class Diagnosable(Protocol):
    """A driver that adds looks of its own."""

    @abstractmethod
    def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """Look without moving anything; see the module."""


def problem_from_error(check: str, error: Exception, device: str, otherwise: str) -> CheckResult:
    """A finding from one of our one-line errors: what was seen before the last `; `, what to do behind it.

    device: left out of the line where it leads it. otherwise: what to do where the error does not say.
    """
    text = str(error).removeprefix(f"{device}: ")
    observed, found, action = text.rpartition("; ")
    return problem(check, observed if found else text, action if found else otherwise)
