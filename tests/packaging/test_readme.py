"""The README files are true: commands parse, paths exist, and the fault table names every fault."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from sandbox import ROOT

from slipguard.cli.app import app
from slipguard.control.reports import FaultCode
from tests.campaigns.command_line import app as campaigns

README_MAX_BYTES = 10_240
README = (ROOT / "README.md").read_text(encoding="utf-8")
FOLDERS = ("", "slipguard", "drivers", "systemd", "tests", "models", ".github")
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.md"))]
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())

PROGRAMS: dict[str, Any] = {
    "slipguard": typer.main.get_command(app),
    "python -m tests.campaigns": typer.main.get_command(campaigns),
}
COMMAND = re.compile(
    r"^(?:\$ )?(?:sudo )?(?:[\w./]*/)?(slipguard|python -m tests\.campaigns|(?:python -m )?pytest)(?: |$)(.*)"
)
TRY_IT = "python3 -m venv .venv && .venv/bin/pip install . && .venv/bin/slipguard --sim"
TEST_IT = "python3 -m venv .venv && .venv/bin/pip install -e '.[test]' && .venv/bin/python -m pytest"


def code(text: str) -> Iterator[str]:
    """Yield the lines of all code blocks, and what stands between back-ticks."""
    parts = re.split(r"^```.*$", text.replace("\\\n", " "), flags=re.M)
    for block in parts[1::2]:
        for line in block.splitlines():
            yield from (step.strip() for step in re.split(r"&&|;", line.partition(" #")[0]))
    for prose in parts[::2]:
        yield from re.findall(r"`([^`\n]+)`", prose)


def commands(path: Path) -> set[tuple[str, str]]:
    """Return program and arguments of every command in a README; `a|b` are two commands."""
    found = set()
    for text in code(path.read_text(encoding="utf-8")):
        if match := COMMAND.match(text):
            first, *others = re.split(r"\\?\|(?! )", match[2])
            group = first.split()[:1]
            found |= {(match[1], first), *((match[1], " ".join([*group, other])) for other in others)}
    return found


def check(program: str, arguments: str) -> None:
    """Fail if a command or an option does not exist. Square brackets mark what is optional."""
    command, text = PROGRAMS[program], f"`{program} {arguments}`"
    words = re.sub(r"[\[\]]|\.\.\.", " ", re.split(r" [|>] | 2>", arguments)[0]).split()
    while words:
        word = words.pop(0)
        if word.startswith("-"):
            options = {name: option for option in command.params for name in (*option.opts, *option.secondary_opts)}
            name, has_value, _ = word.partition("=")
            assert name in options or name == "--help", f"{text}: no option {name}"
            if not has_value and name in options and not options[name].is_flag and words:
                words.pop(0)
        elif hasattr(command, "commands"):
            assert word in command.commands, f"{text}: no command {word}"
            command = command.commands[word]


@each_file
def test_every_command_exists(path: Path, pytestconfig: pytest.Config) -> None:
    for program, arguments in sorted(commands(path)):
        if program in PROGRAMS:
            check(program, arguments)
            continue
        for word in arguments.split():
            if word.startswith("--"):
                pytestconfig.getoption(word.partition("=")[0])
            elif word.startswith("tests/"):
                assert (ROOT / word.partition("::")[0]).exists(), f"`pytest {arguments}`: no {word}"


@each_file
def test_every_path_exists(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for link in re.findall(r"\]\((?!https?:|mailto:|#)([^)#]+)", text):
        assert (path.parent / link).exists(), link
    for name in re.findall(r"`((?:slipguard|systemd|tests|models|drivers|\.ci|\.github)/[\w./-]*)`", text):
        assert (ROOT / name).exists() or (path.parent / name).exists(), name


def test_two_lines_set_everything_up() -> None:
    """`.ci/run` begins with them."""
    assert re.findall(r"^```sh\n(.*?)\n```$", README, re.M | re.S) == [TRY_IT, TEST_IT]


def test_the_readme_is_short() -> None:
    assert len(README.encode()) <= README_MAX_BYTES


def fault_table() -> list[str]:
    """Return the rows of the table that names faults in its first column."""
    tables = re.findall(r"(?:^\|.*\n)+", README, re.M)
    (table,) = [text for text in tables if sum(f"`{code.value}`" in text for code in FaultCode) > len(FaultCode) // 2]
    return table.splitlines()[2:]


def test_the_fault_table_names_every_fault_once() -> None:
    named = [name for row in fault_table() for name in re.findall(r"`([a-z]+(?: [a-z]+)+)`", row.split("|")[1])]
    assert sorted(named) == sorted(code.value for code in FaultCode)
