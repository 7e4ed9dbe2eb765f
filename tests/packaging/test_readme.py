"""The README files are correct: commands parse, paths exist, and the fault table contains every fault."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import cv2
import pytest
import typer
from documentation import FILES, code, each_file
from sandbox import ROOT, Sandbox

from slipguard.cli.app import app
from slipguard.control.reports import FaultCode
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import SensorUnit
from tests.campaigns.command_line import app as campaigns

README_MAX_BYTES = 10_240
README = (ROOT / "README.md").read_text(encoding="utf-8")

PROGRAMS: dict[str, Any] = {
    "slipguard": typer.main.get_command(app),
    "python -m tests.campaigns": typer.main.get_command(campaigns),
}
COMMAND = re.compile(
    r"^(?:\$ )?(?:sudo )?(?:[\w./]*/)?(slipguard|python -m tests\.campaigns|(?:python -m )?pytest)(?: |$)(.*)"
)
RUN_HERE = (
    "slipguard --help",
    "slipguard version",
    "slipguard check --config config.toml",
    "slipguard measure frames/ --background bg.png",
    "slipguard evaluate markers --out markers.pdf",
    "python -m tests.campaigns --help",
)
"""Commands that need neither devices nor minutes: run as they stand."""


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
    """Parse a command as the program does, without running it. Square brackets mark what is optional.

    A text may name a command without its arguments.
    """
    words = shlex.split(re.sub(r"[\[\]]|\.\.\.", " ", re.split(r" [|>] | 2>", arguments)[0]))
    command, context = PROGRAMS[program], None
    while "--help" not in words:
        try:
            context = command.make_context(command.name, list(words), parent=context, resilient_parsing=not words)
        except Exception as error:  # click's, under typer's name
            if not re.search("Missing|requires an argument", f"{type(error).__name__} {error}"):
                pytest.fail(f"`{program} {arguments}`: {error}")
            return
        words = [*getattr(context, "_protected_args", []), *context.args]
        if not words:
            return
        _, command, words = command.resolve_command(context, words)


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


@pytest.mark.campaign
@pytest.mark.parametrize("command", RUN_HERE)
def test_it_runs_as_it_stands(command: str, sandbox: Sandbox) -> None:
    assert any(" ".join(one).strip() == command for path in FILES for one in commands(path)), "not documented"
    work, camera = sandbox.path / "work", GelCamera(SensorUnit(), seed=7)
    (work / "frames").mkdir()
    cv2.imwrite(str(work / "bg.png"), camera.draw(GelView("")))
    cv2.imwrite(str(work / "frames" / "1.png"), camera.draw(GelView("bar", angle_deg=20.0, depth_mm=0.8)))
    (work / "config.toml").write_bytes((ROOT / "config.toml").read_bytes())
    (work / "tests").symlink_to(ROOT / "tests")
    ran = sandbox.run(
        *shlex.split(command.removeprefix("python ").replace("slipguard", "-m slipguard", 1)), vendor=True
    )
    assert (ran.returncode, ran.stderr) == (0, ""), ran.stderr
    assert ran.stdout


@each_file
def test_every_path_exists(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    for link in re.findall(r"\]\((?!https?:|mailto:|#)([^)#]+)", text):
        assert (path.parent / link).exists(), link
    for name in re.findall(r"`((?:slipguard|systemd|tests|models|drivers|\.ci|\.github)/[\w./-]*)[ `]", text):
        assert (ROOT / name).exists() or (path.parent / name).exists(), name


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
