"""Damaged and hostile inputs of every kind: one line, no traceback, little memory."""

from __future__ import annotations

import json
import selectors
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from slipguard.cli.terminal import progress_bar
from slipguard.errors import InputError
from tests.campaigns.figures import Figure, report
from tests.campaigns.fuzz_cases import KINDS

MEMORY_MAX_MB = 300
CASE_MAX_S = 60.0
"""A case that takes longer counts as hanging; the longest ones take some seconds on a busy machine."""
FAILURES_SHOWN = 10


@dataclass(slots=True)
class FuzzResult:
    """Cases of one kind. outcomes: their number by exit code. failures: "case N: ...", with the file that caused it.

    memory_mb: largest memory of the process.
    """

    kind: str
    cases: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    failures: list[str] = field(default_factory=list)
    memory_mb: float = 0.0


def fuzz(
    kinds: Annotated[list[str] | None, typer.Argument(help=f"Of: {', '.join(KINDS)}. Default: all.")] = None,
    cases: Annotated[int, typer.Option(min=1, help="Cases of each kind.")] = 10_000,
    seed: Annotated[int, typer.Option(min=0, help="Random seed.")] = 0,
    first: Annotated[int, typer.Option(min=0, help="Number of the first case, to repeat one.")] = 0,
    keep: Annotated[
        Path | None, typer.Option(help="Folder for the inputs that failed. Default: none are kept.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Give damaged and hostile inputs to the product; exit 1 after a traceback, a crash, or at more than 300 MB.

    Example: `python -m tests.campaigns fuzz image recording --cases 10000 --keep failed/`
    """
    unknown = [kind for kind in kinds or () if kind not in KINDS]
    if unknown:
        raise InputError(f"{unknown[0]}: no such kind; choose from {', '.join(KINDS)}")
    with progress_bar("fuzz") as show:
        found = [run_kind(kind, cases, seed, first, keep, partial(show, kind)) for kind in kinds or KINDS]
    figures = [
        figure
        for one in found
        for figure in (
            Figure(f"{one.kind}: cases", one.cases, 1, at_least=True),
            Figure(f"{one.kind}: failures", len(one.failures)),
            Figure(f"{one.kind}: memory_mb", round(one.memory_mb, 1), MEMORY_MAX_MB),
        )
    ]
    details = {one.kind: {"outcomes": dict(one.outcomes), "failures": one.failures[:FAILURES_SHOWN]} for one in found}
    report(figures, details, json)


def run_kind(
    kind: str, cases: int, seed: int, first: int, keep: Path | None, progress: Callable[[float], None]
) -> FuzzResult:
    """Run the cases of one kind in a process of its own; a crash or a hanging case starts another process."""
    found = FuzzResult(kind)
    done = 0
    with tempfile.TemporaryDirectory(prefix="slipguard-fuzz-") as folder:
        while done < cases:
            number = first + done
            words = (sys.executable, "-m", "tests.campaigns.fuzz_cases", kind, str(seed), str(number))
            with subprocess.Popen(
                [*words, str(cases - done), folder, str(keep or "")], stdout=subprocess.PIPE, text=True, bufsize=1
            ) as process:
                try:
                    for line in _lines(process):
                        _add(found, json.loads(line))
                        done += 1
                        progress(done / cases)
                finally:
                    process.kill()
            if done < cases:
                found.failures.append(f"case {first + done}: the process crashed or hung ({process.returncode})")
                found.cases, done = found.cases + 1, done + 1
    return found


def _lines(process: subprocess.Popen[str]) -> Any:
    """Yield the lines of a process; end when it does, or writes none for `CASE_MAX_S`."""
    assert process.stdout is not None
    with selectors.DefaultSelector() as selector:
        selector.register(process.stdout, selectors.EVENT_READ)
        while selector.select(CASE_MAX_S):
            line = process.stdout.readline()
            if not line:
                return
            yield line


def _add(found: FuzzResult, case: dict[str, Any]) -> None:
    found.cases += 1
    found.memory_mb = max(found.memory_mb, case["memory_mb"])
    found.outcomes[case["outcome"]] += 1
    if case["failure"]:
        found.failures.append(f"case {case['number']}: {case['failure']}")
