"""Every command has help with an example that the command line accepts."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from command_line import slipguard

from slipguard.cli.app import app

TOP: Any = typer.main.get_command(app)


def leaves(command: Any = TOP, path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    """Every command with the words that name it, groups included."""
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from leaves(inner, (*path, name))


def examples(command: Any) -> list[str]:
    return re.findall(r"`(slipguard [^`]+)`", command.help or "")


def accept(line: str) -> None:
    """Parse a whole command line without running it; raises what the command line would complain of."""
    command, words = TOP, shlex.split(line)[1:]
    context = None
    while words and words[0] in getattr(command, "commands", {}):
        name, command = words[0], command.commands[words[0]]
        context = command.make_context(name, [], parent=context, resilient_parsing=True)
        words = words[1:]
    command.make_context(command.name, words, parent=context)


EVERY = {" ".join(("slipguard", *path)): command for path, command in leaves()}


@pytest.mark.parametrize("line", EVERY)
def test_the_help_has_an_example_that_works(line: str) -> None:
    found = examples(EVERY[line])
    assert found, f"`{line} --help` shows no example"
    for example in found:
        accept(example)
    assert any(example.startswith(line) for example in found)


@pytest.mark.parametrize("line", EVERY)
def test_every_parameter_is_explained(line: str) -> None:
    for parameter in EVERY[line].params:
        if parameter.name != "help":
            assert parameter.help, f"`{line}`: {parameter.name} is not explained"


@pytest.mark.parametrize("line", EVERY)
def test_the_help_is_shown(line: str, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    ran = slipguard(capfd, *line.split()[1:], "--help")
    assert ran.code == 0
    assert line in ran.out
    assert all(len(row) <= 80 for row in ran.out.splitlines())
    assert ran.err == ""


def test_a_wrong_example_is_detected() -> None:
    for wrong in ("slipguard measure frames/ --backgrund bg.png", "slipguard measure", "slipguard ctl guard maybe"):
        with pytest.raises(Exception, match=r"(?i)no such option|missing|not one of"):
            accept(wrong)
