"""The README's safety section names every fault, and the keys and standards that belong there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from slipguard.control.fault import FaultCode
from slipguard.control.params import GuardParams

README = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
SAFETY = README.partition("\n## Safety\n")[2].partition("\n## ")[0]
ROWS = [line.split("|")[1:-1] for line in SAFETY.splitlines() if line.startswith("| ")][1:]


@pytest.mark.parametrize("code", FaultCode)
def test_every_fault_has_its_row(code: FaultCode) -> None:
    rows = [row for row in ROWS if f"`{code.value}`" in row[0]]
    assert len(rows) == 1, code
    assert len(rows[0][1].strip()) > 10


def test_it_names_no_fault_that_does_not_exist() -> None:
    named = {name for row in ROWS for name in re.findall(r"`([a-z]+(?: [a-z]+)+)`", row[0])}
    assert named == {code.value for code in FaultCode}


def test_its_keys_are_those_of_the_configuration() -> None:
    keys = set(re.findall(r"`([a-z]+(?:_[a-z]+)+)[`\s]", SAFETY)) - {"stop_by"}
    assert keys <= set(GuardParams.model_fields), keys - set(GuardParams.model_fields)


def test_what_it_is_not_and_what_must_be_tried_first() -> None:
    assert "no safety function" in SAFETY
    assert "ISO 10218" in SAFETY
    assert "ISO/TS 15066" in SAFETY
    assert "Stop–go under load" in SAFETY
