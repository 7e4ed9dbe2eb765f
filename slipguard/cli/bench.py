"""`slipguard bench`: run time against error on this machine."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import Annotated

import typer


def bench(
    quick: Annotated[bool, typer.Option("--quick", help="One grasp of each object: under a minute.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object instead of the table.")] = False,
    out: Annotated[Path | None, typer.Option(help="Folder for bench.json and bench.png.")] = None,
    model: Annotated[Path | None, typer.Option(help="Another segmentation network (.onnx).")] = None,
) -> None:
    """Time the perception pipeline and measure its error, beside the paper's pipeline, on one core.

    Example: `slipguard bench --quick --out bench/`
    """
    from rich.console import Console
    from rich.progress import Progress

    from slipguard.errors import InputError
    from slipguard.lab import bench as lab
    from slipguard.lab import bench_report

    if out is not None:
        try:
            out.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise InputError(f"--out {out}: the folder cannot be made: {error.strerror}") from error
    progress = Console(stderr=True)
    with Progress(console=progress, transient=True, disable=not progress.is_terminal) as bar:
        task = bar.add_task("bench", total=1.0)
        found = lab.bench(quick, model, lambda what, share: bar.update(task, description=what, completed=share))
    if out is not None:
        bench_report.picture(found, out / "bench.png")
        (out / "bench.json").write_text(jsonlib.dumps(found.as_json(), indent=2) + "\n", encoding="utf-8")
    if json:
        print(jsonlib.dumps(found.as_json()))
        return
    console = Console()
    console.print(bench_report.table(found))
    for line in bench_report.notes(found):
        console.print(line, style="dim")
