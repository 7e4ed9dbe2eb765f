"""Every command that the README shows is executed by a test; the table beside this file says by which."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterator
from typing import Any

import pytest
import typer
from readme_commands import EXECUTED, OPTIONS, OTHERS
from sandbox import ROOT
from used_words import together

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
    """Commands as they stand, without remarks; one that is broken over two lines is one.

    slipguard's own is the same with `sudo` before it and with its whole path.
    """
    found = {" ".join(line.partition("  #")[0].split()) for line in lines()}
    found = {re.sub(r"^(sudo )?/opt/slipguard/bin/slipguard ", "slipguard ", line) for line in found}
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


def options_of(line: str) -> Iterator[str]:
    """The options of a line with the command they belong to: `slipguard ctl --url X state` has "ctl --url"."""
    alternatives = line.split("\\|") if "=" not in line else [line]
    stem = " ".join(alternatives[0].split()[:2])
    for alternative in (alternatives[0], *(f"{stem} {one}" for one in alternatives[1:])):
        words = alternative.replace("[", " ").replace("]", " ").split()
        command: Any = TOP
        path: list[str] = []
        for word in words[1:]:
            if word in getattr(command, "commands", {}):
                command = command.commands[word]
                path.append(word)
            elif word.startswith("--"):
                assert word in {name for one in command.params for name in (*one.opts, *one.secondary_opts)}, line
                yield f"{' '.join(path) or '--sim'} {word}"


OWN = sorted({leaf for line in shown() if line.startswith("slipguard ") for leaf in leaves(line)} - GROUPS)
OWN_OPTIONS = sorted({one for line in shown() if line.startswith("slipguard ") for one in options_of(line)})
FOREIGN = [line for line in shown() if not line.startswith("slipguard ")]


@pytest.mark.parametrize("command", OWN)
def test_a_command_of_the_readme_is_executed(command: str) -> None:
    assert command in EXECUTED, f"`slipguard {command}` is in the README: say in readme_commands.py what executes it"


@pytest.mark.parametrize("option", OWN_OPTIONS)
def test_an_option_of_the_readme_is_used(option: str) -> None:
    """In one statement with its command; in a test of that command alone, which may have a helper, anywhere."""
    command, _, name = option.rpartition(" ")
    place = OPTIONS.get(option) or EXECUTED[command]
    file = place.partition("::")[0]
    alone = option in OPTIONS or sum(one.startswith(file) for one in EXECUTED.values()) == 1
    words = (name,) if alone else (command.split()[-1], name)
    assert together(ROOT / file, *words), (
        f"`slipguard {option}`: {file} uses it nowhere; say in readme_commands.py what does"
    )


@pytest.mark.parametrize("line", FOREIGN)
def test_a_line_for_another_program_is_accounted_for(line: str) -> None:
    assert line in OTHERS, f"`{line}` is in the README: say in readme_commands.py what executes it"
    file, words = OTHERS[line]
    assert words in (ROOT / file).read_text(), f"`{line}`: {file} does not have {words}"


@pytest.mark.parametrize("line", [line for line in FOREIGN if line.startswith(("pytest ", "python tests/"))])
def test_a_line_for_a_tool_of_the_tests_names_what_is_there(line: str) -> None:
    _, *words = shlex.split(line)
    taken = (ROOT / "tests" / "conftest.py").read_text()
    if words[0].endswith(".py"):
        taken += (ROOT / words[0]).read_text()
    for word in words:
        if word.startswith("tests/"):
            assert (ROOT / word).exists(), line
        if word.startswith("--"):
            assert f'"{word}"' in taken, line


def whole(command: Any = TOP, path: tuple[str, ...] = ()) -> Iterator[str]:
    """Every command there is, groups aside."""
    inner = getattr(command, "commands", None)
    if not inner:
        yield " ".join(path)
    for name, one in (inner or {}).items():
        yield from whole(one, (*path, name))


def test_every_command_there_is_has_its_test() -> None:
    assert set(whole()) | {"--sim"} == set(EXECUTED)


@pytest.mark.parametrize(("command", "place"), EXECUTED.items())
def test_the_named_test_exists_and_runs_the_command(command: str, place: str) -> None:
    file, _, test = place.partition("::")
    if test:
        assert re.search(rf"^(?:async )?def {test}\(", (ROOT / file).read_text(), re.M), place
    assert together(ROOT / file, command.split()[-1]), f"{place} does not run {command}"


def test_no_line_of_the_tables_is_stale() -> None:
    assert sorted(set(OTHERS) - set(FOREIGN)) == []
    assert sorted(set(OPTIONS) - set(OWN_OPTIONS)) == []
