"""The command line as a user meets it, in this process."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import structlog

from slipguard.cli.app import run


@dataclass(frozen=True)
class Ran:
    """What one command did."""

    code: int
    out: str
    err: str

    @property
    def complaint(self) -> str:
        """The one line that an expected failure is; anything else fails the test."""
        assert self.code in (1, 2), f"exit code {self.code}"
        assert self.err.startswith("slipguard: "), self.err
        assert self.err.count("\n") == 1, self.err
        assert "Traceback" not in self.err
        return self.err.removeprefix("slipguard: ").rstrip("\n")


def slipguard(capfd: pytest.CaptureFixture[str], *words: object) -> Ran:
    """Run `slipguard WORDS...`; what C libraries write is caught, too."""
    capfd.readouterr()
    try:
        code = run([str(word) for word in words])
    finally:
        structlog.reset_defaults()
    said = capfd.readouterr()
    return Ran(code, said.out, said.err)
