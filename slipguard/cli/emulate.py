"""`slipguard emulate`: device emulators on the real protocol, one command for each registered emulator."""

from __future__ import annotations

import asyncio
from collections.abc import MutableMapping
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

from slipguard.cli.options import field_option, make_command, parameter

if TYPE_CHECKING:
    from slipguard.registry import EmulatorKind

FaultsOption = Annotated[
    list[str] | None,
    typer.Option("--fault", help="NAME, NAME:PROBABILITY (0.01) or NAME:COUNT (3); may be repeated."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print events, states and responses as JSON lines.")]


class Emulators(TyperGroup):
    """The registered emulators; each is imported only when it is used."""

    _built: dict[str, Any]

    @property
    def commands(self) -> MutableMapping[str, Any]:
        return {name: self.get_command(None, name) for name in _names()}

    @commands.setter
    def commands(self, value: object) -> None:
        self._built = {}

    def list_commands(self, ctx: object) -> list[str]:
        return _names()

    def get_command(self, ctx: object, cmd_name: str) -> Any:
        if cmd_name not in self._built and cmd_name in _names():
            from slipguard.registry import load_emulator

            self._built[cmd_name] = _command(cmd_name, load_emulator(cmd_name))
        return self._built.get(cmd_name)


app = typer.Typer(
    cls=Emulators,
    no_args_is_help=True,
    help="Emulate a device on its real protocol, with faults on demand, until Ctrl-C or SIGTERM. Commands are read "
    "from stdin: `fault NAME [probability|count]`, `clear`, `state`, `log`, `quit`; `help` lists all.\n\n"
    "Example: `slipguard emulate robotiq --link /tmp/ttyGR --object-width-mm 40 --fault late:0.01`",
)


def _names() -> list[str]:
    from slipguard.registry import EMULATORS, driver_names

    return driver_names(EMULATORS)


def _command(name: str, kind: EmulatorKind) -> Any:
    """Return the command of one emulator: its settings become options, its docstring the help."""

    def emulate(fault: list[str] | None, json: bool, **options: Any) -> None:
        from pydantic import ValidationError

        from slipguard.cli.interrupt import default_interrupts
        from slipguard.config_errors import describe_validation_error
        from slipguard.errors import InputError
        from slipguard.tools.emulation import run

        try:
            settings = kind.Settings(**{key: value for key, value in options.items() if value is not None})
        except ValidationError as error:
            raise InputError(describe_validation_error(error, kind.Settings)) from None
        with default_interrupts():
            asyncio.run(run(name, lambda report: kind(settings, report), fault or [], json_lines=json))

    fields = [field_option(one, field) for one, field in kind.Settings.model_fields.items()]
    parameters = [*fields, parameter("fault", FaultsOption, None), parameter("json", JsonOption, False)]
    alone = typer.Typer(add_completion=False, rich_markup_mode="markdown")
    alone.command(name)(make_command(emulate, kind.__doc__, parameters))
    return typer.main.get_command(alone)
