"""Options that several commands share."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

USUAL_FILE = Path("config.toml")
ConfigOption = Annotated[Path, typer.Option("--config", "-c", help="The configuration file.")]
SocketOption = Annotated[Path | None, typer.Option(help="Socket of a running daemon. Default: searched.")]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
JobsOption = Annotated[int, typer.Option(min=0, help="Processes; 0: one per core.")]
ClusterOption = Annotated[
    str | None,
    typer.Option(help="Dask scheduler to use instead of this machine, with access to the same files: tcp://HOST:8786."),
]
