"""Result of one check by `slipguard doctor`, and how a driver adds its own checks.

A driver may have a method

    def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]

for what only the driver knows: files, permissions, cables, adapters, controllers. It is called before `open()`.
owned: a running daemon has the device open, so check from outside only. The method moves nothing, raises nothing that a
user could cause, and ends within a few seconds. The doctor itself checks what the port offers: frames, round trips,
states.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import AsyncIterator
from dataclasses import dataclass
from enum import StrEnum
from typing import Protocol, runtime_checkable


class CheckStatus(StrEnum):
    """ok: as it should be. note: works, but worth knowing. problem: does not work."""

    OK = "ok"
    NOTE = "note"
    PROBLEM = "problem"


@dataclass(frozen=True, slots=True)
class CheckResult:
    """check: its name, in two or three words. action: what to do; never empty for a problem."""

    check: str
    status: CheckStatus
    observed: str
    action: str = ""


def ok(check: str, observed: str) -> CheckResult:
    """Return the result of a check that passed."""
    return CheckResult(check, CheckStatus.OK, observed)


def note(check: str, observed: str, action: str = "") -> CheckResult:
    """Return the result of a check that passed, with something worth knowing."""
    return CheckResult(check, CheckStatus.NOTE, observed, action)


def problem(check: str, observed: str, action: str) -> CheckResult:
    """Return the result of a check that failed. action: what to do next."""
    return CheckResult(check, CheckStatus.PROBLEM, observed, action)


def problem_from_error(check: str, error: Exception | str, device: str, default_action: str) -> CheckResult:
    """Return a problem from an error or its message: what was observed before the last `; `, the action after it.

    device: its name is removed from the beginning of the message. default_action: if the message has none.
    """
    text = str(error).removeprefix(f"{device}: ")
    observed, separator, action = text.rpartition("; ")
    return problem(check, observed if separator else text, action if separator else default_action)


@runtime_checkable
class Diagnosable(Protocol):
    """A driver with checks of its own."""

    @abstractmethod
    def diagnose(self, *, owned: bool) -> AsyncIterator[CheckResult]:
        """Check without moving anything; see the module."""
