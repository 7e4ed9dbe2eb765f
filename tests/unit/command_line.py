"""Runs the command line in this process."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import pytest
import structlog

from slipguard.cli.app import run


@dataclass(frozen=True)
class Ran:
    """Result of one command."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """Return the line of an expected failure; anything else fails the test."""
        assert self.code in (1, 2), f"exit code {self.code}"
        assert self.err.startswith("slipguard: "), self.err
        assert self.err.count("\n") == 1, self.err
        assert "Traceback" not in self.err
        return self.err.removeprefix("slipguard: ").rstrip("\n")


def slipguard(capfd: pytest.CaptureFixture[str], *words: object, run: Callable[[list[str]], int] = run) -> Ran:
    """Run `slipguard WORDS...`, or another command line; output of C libraries is captured, too."""
    capfd.readouterr()
    try:
        code = run([str(word) for word in words])
    finally:
        structlog.reset_defaults()
    output = capfd.readouterr()
    return Ran(code, output.out, output.err)
