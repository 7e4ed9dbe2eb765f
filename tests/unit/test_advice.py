"""Every advice of the program, read as if one's hand were under the object or between the jaws.

The texts are taken from the source: all strings but docstrings, with `{}` for values. What a text must say before it
advises something stands in the table.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from slipguard.control.reports import FaultCode, Text
from slipguard.devices import ACTIVATION_HINT

ROOT = Path(__file__).parents[2]
SOURCES = [
    *(ROOT / "slipguard").rglob("*.py"),
    *(ROOT / "drivers").glob("slipguard_drivers/**/*.py"),
    *(ROOT / "drivers").glob("slipguard_client/*.py"),
    *(ROOT / "drivers").glob("slipguard_ros/slipguard_ros/*.py"),
    *(ROOT / "drivers").glob("lerobot_*/lerobot_*/*.py"),
]
NO_HAND = ("/sim/", "/sim_lifts/", "/bench/", "/stress/", "/cli/app.py")
"""Simulated devices, and no devices."""
RULES: list[tuple[str, str, str]] = [
    (
        "releasing is only advised after the object is supported",
        (
            r"(?:^|(?:\b(?:then|or|and|use|run|call|to)\b|[,;:])\s+)(?:`?slipguard ctl |~/|`)?release\b"
            r"(?! (?:the button|its brakes))"
        ),
        r"support",
    ),
    (
        "what is in the jaws is only taken out after it is supported",
        r"\btake (?:it|the object|what)\b|\bremove (?:it|the object)\b",
        r"support|cannot calibrate",  # a calibration is refused while the gripper holds something
    ),
    (
        "an activation is only advised for empty jaws, without hands and with what it does",
        r"\b(?:run|then) `slipguard ctl activate`",
        r"empty jaws, covered gels and no hand near",
    ),
    ("closing the jaws is only advised without a hand in them", r"\bgrasp again\b", r"no hand"),
]
"""What the rule says, an advice, and what must stand before it in the same text."""


def texts_of(source: str) -> Iterator[str]:
    """All strings of a module but its docstrings."""
    tree = ast.parse(source)
    left_out = {id(one.value) for one in ast.walk(tree) if isinstance(one, ast.Expr)}
    for one in ast.walk(tree):
        if isinstance(one, ast.JoinedStr):
            left_out |= {id(part) for part in one.values}
            yield "".join(str(part.value) if isinstance(part, ast.Constant) else "{}" for part in one.values)
    for one in ast.walk(tree):
        if isinstance(one, ast.Constant) and isinstance(one.value, str) and id(one) not in left_out:
            yield one.value


def all_texts() -> set[str]:
    found = {
        text for path in SOURCES if not any(one in str(path) for one in NO_HAND) for text in texts_of(path.read_text())
    }
    return {text for text in found if " " in text and "Example:" not in text}


def what_breaks(text: str) -> list[str]:
    """The rules that a text breaks."""
    return [
        rule
        for rule, advice, before in RULES
        for match in re.finditer(advice, text)
        if not re.search(before, text[: match.start()], re.IGNORECASE)
    ]


def fault_calls() -> Iterator[tuple[set[str], ast.expr]]:
    """Every fault that the program constructs: its possible codes and its advice, as they stand in the source."""
    for path in (ROOT / "slipguard").rglob("*.py"):
        for one in ast.walk(ast.parse(path.read_text())):
            if isinstance(one, ast.Call) and isinstance(one.func, ast.Name) and one.func.id == "Fault" and one.args:
                yield {part.attr for part in ast.walk(one.args[0]) if isinstance(part, ast.Attribute)}, one.args[-1]


def test_no_text_breaks_a_rule() -> None:
    broken = {text: rules for text in all_texts() if (rules := what_breaks(text))}
    assert broken == {}


def test_no_text_says_that_a_release_activates_or_closes() -> None:
    wrong = re.compile(r"release[^.;]*(?:activates|closes? fully)|activates[^.;]*release")
    assert [text for text in all_texts() if wrong.search(text)] == []


def test_every_fault_has_an_advice_that_is_checked() -> None:
    checked, codes = all_texts(), set()
    for possible, advice in fault_calls():
        codes |= possible
        if isinstance(advice, ast.Constant):
            assert advice.value in checked, "it stands in the source as one string"
        else:
            assert isinstance(advice, ast.Name), "or it has a name, and its strings are checked where it gets them"
    assert codes >= {code.name for code in FaultCode}


def test_every_message_is_checked_as_it_is_put_together() -> None:
    assert {text.name: rules for text in Text if (rules := what_breaks(str(text.value)))} == {}


@pytest.mark.parametrize(
    "text",
    [
        "take the object away, release, and clear",
        "check both fingers, or release",
        "release it, but support the object first",
        "not activated; run `slipguard ctl activate`: the jaws open and close fully",
        "the closing was interrupted; grasp again",
        "an object is held and would drop; use release",
        "hold it, then run `slipguard ctl release`",
    ],
)
def test_a_dangerous_advice_is_found(text: str) -> None:
    assert what_breaks(text)


@pytest.mark.parametrize(
    "text", ["support the object, then release it", ACTIVATION_HINT, "release the button, then go on"]
)
def test_a_good_one_passes(text: str) -> None:
    assert what_breaks(text) == []


@pytest.mark.parametrize(("page", "rows"), [("README.md", "| `"), ("systemd/README.md", "| ")])
def test_the_tables_of_faults_and_troubles_keep_to_the_rules(page: str, rows: str) -> None:
    lines = [line for line in (ROOT / page).read_text().splitlines() if line.startswith(rows)]
    lines = [line for line in lines if not line.startswith("| `slipguard ")]  # the table of commands
    assert {line: broken for line in lines if (broken := what_breaks(line))} == {}
