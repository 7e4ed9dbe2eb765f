"""The controller commands and reports what the golden files have, in every phase, for every request and failure."""

from __future__ import annotations

from difflib import unified_diff

import pytest
from golden_cases import FOLDER, cases

from slipguard.control.state import Phase


@pytest.mark.parametrize("phase", Phase)
def test_every_case_is_as_in_the_golden_file(phase: Phase) -> None:
    different = []
    for name, found in zip((phase, f"{phase}_texts"), cases(phase), strict=True):
        kept = (FOLDER / f"{name}.txt").read_text(encoding="utf-8").splitlines()
        different += [*unified_diff(kept, found, n=0, lineterm="")]
    assert not different, (
        "the controller has changed; if intended: `PYTHONPATH=tests/unit python tests/unit/control/golden_cases.py` "
        "and review the diff:\n" + "\n".join(different[:20])
    )


@pytest.mark.parametrize("phase", Phase)
def test_the_golden_file_itself_keeps_the_safety_rules(phase: Phase) -> None:
    for line in (FOLDER / f"{phase}.txt").read_text(encoding="utf-8").splitlines():
        name, steps = line.split(": ", 1)
        assert ("RELEASE" in steps) <= (name.startswith("release") or phase is Phase.RELEASED), line
        if "protective stop" in name or "emergency stop" in name:
            assert "HOLD" not in steps, line
        if phase is Phase.FAULT:
            assert "MOVE" not in steps, line
