"""Options that several commands share, and options made of the fields of a pydantic model."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Annotated, Any

import typer
from pydantic.fields import FieldInfo

USUAL_FILE = Path("config.toml")
ConfigOption = Annotated[Path, typer.Option("--config", "-c", help="The configuration file.")]
SocketOption = Annotated[
    Path | None,
    typer.Option("--socket", help="Unix socket of the daemon. Default: this user's daemon, then the system's."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]
JobsOption = Annotated[int, typer.Option(min=0, help="Processes; 0: one per core.")]
ClusterOption = Annotated[
    str | None,
    typer.Option(help="Dask scheduler to use instead of this machine, with access to the same files: tcp://HOST:8786."),
]


def parameter(name: str, kind: Any, default: object = inspect.Parameter.empty) -> inspect.Parameter:
    """Return a parameter of a command that is put together from its parts."""
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=kind)


def field_option(name: str, field: FieldInfo) -> inspect.Parameter:
    """Return the option of a field: its annotation, description and default. pydantic validates the value."""
    flag = [f"--{name.replace('_', '-')}"] if field.annotation is bool and field.default is False else []
    kind = Annotated[field.annotation, typer.Option(*flag, help=field.description)]  # type: ignore[name-defined]
    return parameter(name, kind, field.get_default(call_default_factory=True))


def make_command(run: Callable[..., None], help_text: str | None, parameters: Iterable[inspect.Parameter]) -> Any:
    """Return `run`, which takes these parameters by name, in the form that typer reads."""
    parameters = list(parameters)
    run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    run.__annotations__ = {one.name: one.annotation for one in parameters}
    run.__doc__ = help_text
    return run
