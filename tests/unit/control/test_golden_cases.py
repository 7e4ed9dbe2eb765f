"""The law does, says and remembers what the ledger has, in every phase, for every wish and every mishap."""

from __future__ import annotations

from itertools import zip_longest

from golden_cases import LEDGER, ledger

from slipguard.control.state import Phase


def test_nothing_has_changed_unnoticed() -> None:
    kept = LEDGER.read_text(encoding="utf-8").splitlines()
    for line, now in zip_longest(kept, ledger()):
        assert now == line, (
            "the controller has changed; if intended: python tests/unit/control/golden_cases.py, and review"
        )


def test_what_it_must_never_hold() -> None:
    """Not a golden file that nobody looked at: the rules hold in every line of it."""
    for line in LEDGER.read_text(encoding="utf-8").splitlines():
        names, told = line.split(" => ")
        for name in names.split("; "):
            asked = ": release" in name
            assert ("release_width_mm" in told) <= (asked or name.startswith(Phase.RELEASED)), line
            if "protective stop" in name or "emergency stop" in name:
                assert "hold_force_n" not in told, line
            if name.startswith(Phase.FAULT):
                assert "move_width_mm" not in told, line
