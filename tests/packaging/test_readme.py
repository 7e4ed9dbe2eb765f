"""The README tells the truth: its set-up lines are those of the gate, and its commands exist with those options."""

from __future__ import annotations

import re
import shlex
import tomllib
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import Mock

import pytest
import typer
from config_table import in_readme, table
from sandbox import ROOT

from slipguard.cli.app import app
from slipguard.web.app import make_app
from slipguard.web.route_context import RouteContext

if TYPE_CHECKING:
    from slipguard.daemon.api.daemon_api import DaemonApi

README = (ROOT / "README.md").read_text()
GATE = (ROOT / ".ci" / "run").read_text().replace("\\\n", "")
ON_BOTH_CORES = ["-n", "2"]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
TOP: Any = typer.main.get_command(app)


def set_up_lines() -> list[list[list[str]]]:
    """The shell blocks of the README: each one line of commands joined by &&, each command as words."""
    blocks = re.findall(r"```sh\n(.*?)```", README, re.S)
    return [[shlex.split(step) for step in block.strip().split(" && ")] for block in blocks]


def test_two_lines_set_everything_up() -> None:
    to_try, to_test = set_up_lines()
    assert to_try[0] == to_test[0] == ["python3", "-m", "venv", ".venv"]
    assert to_try[1:] == [[".venv/bin/pip", "install", "."], [".venv/bin/slipguard", "--sim"]]
    assert to_test[1:] == [[".venv/bin/pip", "install", "-e", ".[test]"], [".venv/bin/python", "-m", "pytest"]]
    assert "test" in PROJECT["optional-dependencies"]
    assert "slipguard" in PROJECT["scripts"]


def test_the_gate_runs_the_same_lines() -> None:
    steps = [shlex.split(line) for line in GATE.splitlines() if line and not line.lstrip().startswith("#")]
    plain = [["-e" if word == "--editable" else word for word in step if word != "--quiet"] for step in steps]
    (_, install, test) = set_up_lines()[1]
    assert any(step[1:3] == ["-m", "venv"] for step in plain)
    assert ["python", "-m", "pip", *install[1:]] in plain
    assert ["python", *test[1:], *ON_BOTH_CORES] in plain
    assert plain.index(["python", "-m", "pip", *install[1:]]) < plain.index(["python", *test[1:], *ON_BOTH_CORES])


def resolve(words: list[str]) -> tuple[Any, list[str]]:
    """The command that the words name, and what is left of them."""
    command, rest = TOP, list(words)
    while rest and rest[0] in getattr(command, "commands", {}):
        command = command.commands[rest.pop(0)]
    return command, rest


def check(text: str) -> None:
    """A command line as the README writes it: [optional], alternatives with \\|, PLACES in capitals."""
    words = re.sub(r"[\[\]]|\.\.\.", " ", text).split()
    assert words[0] == "slipguard"
    command, rest = resolve(words[1:])
    options = {name for param in command.params for name in (*param.opts, *param.secondary_opts)}
    for word in rest:
        if word.startswith("-"):
            assert word in options, f"`{text}`: {command.name} has no {word}"
    if not rest or rest[0].startswith("-"):
        return
    assert not getattr(command, "commands", None), f"`{text}`: no such command"


TABLE = re.findall(r"^\| `(slipguard[^`]*)`", README, re.M)
MENTIONED = re.findall(r"`(slipguard(?: [^`]+)?)`", README)


def alternatives(text: str) -> list[str]:
    """`slipguard ctl a\\|b c` is `slipguard ctl a` and `slipguard ctl b c`."""
    first, *others = text.split("\\|")
    stem = " ".join(first.split()[:2])
    return [first, *(f"{stem} {other}" for other in others)]


@pytest.mark.parametrize("text", sorted({one for text in TABLE + MENTIONED for one in alternatives(text)}))
def test_every_command_in_the_readme_exists(text: str) -> None:
    if "/" not in text.split()[0] and not text.startswith("slipguard["):
        check(text)


def test_every_command_is_in_the_table() -> None:
    told = {text.split()[1] for text in TABLE if not text.split()[1].startswith("-")}
    assert told == set(TOP.commands)
    (ctl,) = [text for text in TABLE if text.startswith("slipguard ctl")]
    told_ctl = {one.split()[2] for one in alternatives(ctl)}
    assert told_ctl == set(TOP.commands["ctl"].commands)


def test_every_path_of_the_api_is_in_its_table() -> None:
    paths = make_app(RouteContext(cast("DaemonApi", Mock()))).openapi()["paths"]
    there = {(method.upper(), path.replace("{finger}", "left")) for path, asked in paths.items() for method in asked}
    section = README.partition("## The local API")[2].partition("\n## ")[0]
    told = set()
    for methods, cell in re.findall(r"^\| (?:`(GET|POST) |WebSocket )(.*?) \|", section, re.M):
        told |= {(methods, path.strip("` ")) for path in cell.split("` `")} if methods else set()
    assert told == there


def test_every_path_and_extra_it_names_is_there() -> None:
    for path in set(re.findall(r"`((?:slipguard|systemd|tests|models|drivers)/[\w./-]+)`", README)):
        assert (ROOT / path).exists(), path
    for extra in re.findall(r"slipguard\[(\w+)\]", README):
        assert extra in PROJECT["optional-dependencies"]
    for link in re.findall(r"\]\((?!http)([^)#]+)\)", README):
        assert (ROOT / link).exists(), link


def test_the_table_of_the_configuration_is_that_of_config_toml() -> None:
    assert in_readme() == table(), "config.toml has changed: run `python tests/packaging/config_table.py`"


def test_the_keys_it_names_are_in_the_configuration() -> None:
    configuration = Path(ROOT / "config.toml").read_text()
    for key in ("force_max_n", "mode", "give_up_rotation_deg", "blind_force_n", "on_blind", "fps"):
        assert f"`{key}`" in README or f"`{key} = " in README
        assert re.search(rf"^(# )?{key} = ", configuration, re.M), key
