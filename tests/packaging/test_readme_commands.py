"""Every command that the README shows is executed by a test; the table beside this file says by which."""

from __future__ import annotations

import re
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from readme_commands import EXECUTED, OTHERS
from sandbox import ROOT

from slipguard.cli.app import app

README = (ROOT / "README.md").read_text()
TOP: Any = typer.main.get_command(app)
GROUPS = {name for name, command in TOP.commands.items() if getattr(command, "commands", None)}
PROGRAMS = (
    "slipguard ", "pytest ", "python ", "python3 ", "pip ", "systemctl ", "journalctl ", "usbip ", "ros2 ", "apt-get ",
    "curl ", "schemathesis ", "mutmut ", ".ci/", ".venv/", "sudo ",
)  # fmt: skip


def lines() -> Iterator[str]:
    """Every line of a block of commands, and every command in the text."""
    for kind, block in re.findall(r"^```(\w*)\n(.*?)^```", README, re.S | re.M):
        if kind in ("", "sh"):
            yield from block.splitlines()
    plain = re.sub(r"^```.*?^```", "", README, flags=re.S | re.M)
    yield from re.findall(r"^    (\S.*)$", plain, re.M)
    for paragraph in plain.split("\n\n"):
        yield from (code.replace("\n", " ") for code in paragraph.split("`")[1::2])


def shown() -> list[str]:
    """Commands as they stand, without remarks; one that is broken over two lines is one."""
    found = {line.partition("  #")[0].strip() for line in lines()}
    return sorted(line for line in found if line.startswith(PROGRAMS))


def leaves(text: str) -> list[str]:
    """The commands that a line of the README stands for: `slipguard ctl a\\|b c` is "ctl a" and "ctl b"."""
    words = re.sub(r"[\[\]]", " ", text.replace("\\|", "|")).removeprefix("slipguard ").split()
    if words[0].startswith("-"):
        return ["--sim"]
    if words[0] not in getattr(TOP, "commands", {}):
        return [words[0]]
    inner = getattr(TOP.commands[words[0]], "commands", None)
    if not inner:
        return [words[0]]
    named = [one for word in words[1:] for one in word.split("|") if one in inner]
    return [f"{words[0]} {one}" for one in named] or [words[0]]


OWN = sorted({leaf for line in shown() if line.startswith("slipguard ") for leaf in leaves(line)} - GROUPS)
FOREIGN = [line for line in shown() if not line.startswith("slipguard ")]


def whole(command: Any = TOP, path: tuple[str, ...] = ()) -> Iterator[str]:
    """Every command there is, groups aside."""
    inner = getattr(command, "commands", None)
    if not inner:
        yield " ".join(path)
    for name, one in (inner or {}).items():
        yield from whole(one, (*path, name))


@pytest.mark.parametrize("command", OWN)
def test_a_command_of_the_readme_is_executed(command: str) -> None:
    assert command in EXECUTED, f"`slipguard {command}` is in the README: say in readme_commands.py what executes it"


@pytest.mark.parametrize("line", FOREIGN)
def test_a_line_for_another_program_is_accounted_for(line: str) -> None:
    known = [begin for begin in OTHERS if line.startswith(begin)]
    assert known, f"`{line}` is in the README: say in readme_commands.py what executes it"


def test_every_command_there_is_has_its_test() -> None:
    assert set(whole()) | {"--sim"} == set(EXECUTED)


@pytest.mark.parametrize(("command", "place"), [*EXECUTED.items(), *OTHERS.items()])
def test_the_named_test_exists_and_names_the_command(command: str, place: str) -> None:
    file, _, test = place.partition("::")
    text = (ROOT / file).read_text()
    if test:
        assert re.search(rf"^(?:async )?def {test}\(", text, re.M), place
    if command in EXECUTED:
        assert re.search(rf"\b{re.escape(command.split()[-1].lstrip('-'))}\b", text), f"{place} does not name {command}"


def test_no_line_of_the_table_is_stale() -> None:
    assert [begin for begin in OTHERS if not any(line.startswith(begin) for line in FOREIGN)] == []
