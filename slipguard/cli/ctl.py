"""`slipguard ctl`: send requests to a running daemon."""

from __future__ import annotations

import inspect
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import ValidationError

from slipguard.cli.options import SocketOption, field_option, make_command, parameter
from slipguard.config_errors import describe_validation_error
from slipguard.daemon.api.requests import REQUESTS
from slipguard.errors import InputError, SlipguardError

if TYPE_CHECKING:
    from slipguard.daemon.api.client import Client, TcpAddress

app = typer.Typer(
    no_args_is_help=True,
    help="Send requests to a running daemon. Exit code 1 with the daemon's reason if it refuses.\n\n"
    "Example: `slipguard ctl state`, `slipguard ctl grasp`, `slipguard ctl lift`, `slipguard ctl release --yes`",
)

JsonOption = Annotated[bool, typer.Option("--json", help="Print the daemon's response as one JSON object.")]
YesOption = Annotated[bool, typer.Option("--yes", "-y", help="Do not ask for confirmation.")]
ACTIVATION_QUESTION = (
    "The jaws open and close fully, at full speed and force, and press the gels against each other. Take the gels off "
    "or cover them with something soft, empty the jaws and keep your hands out. Activate the gripper?"
)
RELEASE_QUESTION = (
    "Open the jaws? A held object drops: support it. A gripper that is not active opens slowly and fully, and must be "
    "activated afterwards."
)


class OnOff(StrEnum):
    """on or off."""

    on = "on"
    off = "off"


@dataclass(frozen=True, slots=True)
class ConnectionOptions:
    """The options between `ctl` and the command."""

    socket: Path | None
    url: str | None
    token_file: Path | None


@app.callback()
def connection(
    context: typer.Context,
    socket: SocketOption = None,
    url: Annotated[
        str | None, typer.Option(help="Connect over TCP, such as http://127.0.0.1:8470, not over the Unix socket.")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="The daemon's token, for --url. Default on this machine: this user's, then the system's."),
    ] = None,
) -> None:
    """Store the connection options for the command that follows."""
    if token_file is not None and url is None:
        raise InputError("--token-file needs --url; the Unix socket does not use a token")
    context.obj = ConnectionOptions(socket, url, token_file)


@app.command()
def state(context: typer.Context, socket: SocketOption = None, json: JsonOption = False) -> None:
    """Show the state: the grasp, each device, and what to do about a fault.

    Example: `slipguard ctl state`, `slipguard ctl state --json`
    """
    with _client(context, socket) as client:
        response = client.state()
    if json:
        _print_json(response)
        return
    from rich.console import Console

    from slipguard.cli.state_view import state_table
    from slipguard.daemon.api.state import State

    Console(highlight=False).print(state_table(State.model_validate(response)))


@app.command()
def fingertips(
    context: typer.Context,
    yes: YesOption = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Measure the thickness of the fingertip sensors: close the empty jaws gently until the gels touch.

    Calibrate first. The jaws close in small steps with the lowest force, which takes about a minute, and open again.
    Then set fingertip_mm as printed and restart the daemon. A second run checks that the gels stay apart.

    Example: `slipguard ctl fingertips`
    """
    if not yes and not _confirm("The empty jaws close step by step until the gels touch, and open again. Measure?"):
        raise typer.Exit(1)
    import asyncio

    from slipguard.tools.fingertips import FingertipMeasurement, describe

    with _client(context, socket) as client:
        measurement = FingertipMeasurement(
            lambda: asyncio.to_thread(client.state),
            lambda request: asyncio.to_thread(client.submit, request),
            lambda width_mm: None if json else typer.echo(f"\r{width_mm:5.1f} mm", nl=False, err=True),
        )
        touch_mm = asyncio.run(measurement.run())
    if json:
        _print_json({"touch_width_mm": touch_mm, "add_mm": None if touch_mm is None else touch_mm / 2.0})
    else:
        typer.echo(err=True)
        typer.echo(describe(touch_mm))


@app.command()
def page(
    context: typer.Context,
    open_browser: Annotated[bool, typer.Option("--open", help="Open the link in a browser on this machine.")] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Print a link to the operator page. The first browser that opens it, within a minute, gets control.

    Without such a link the page is read-only. As root, open the printed link in your own browser.

    Example: `slipguard ctl page --open`
    """
    if open_browser and os.geteuid() == 0:
        raise InputError("--open: browsers do not run as root; omit --open and open the link in your own browser")
    with _client(context, socket) as client:
        response = client.page_link()
    if json:
        _print_json(response)
    else:
        typer.echo(response["url"])
    if open_browser:
        import webbrowser

        if not webbrowser.open(str(response["url"])):
            raise SlipguardError("no browser could be started; open the printed link in a browser within a minute")


def _confirm(question: str) -> bool:
    """Return True if the user types yes; False for any other input, its end, or Ctrl-C."""
    try:
        return typer.confirm(question, err=True)
    except typer.Abort:
        typer.echo(err=True)
        return False


def _address(context: typer.Context, socket: Path | None) -> Path | TcpAddress | None:
    """Return the daemon's address. Options after the command have priority over those before it."""
    before: ConnectionOptions = context.obj
    if before.url is None:
        return socket or before.socket
    if socket or before.socket:
        raise InputError("--url and --socket cannot be combined; omit one of them")
    from slipguard.daemon.api.client import TcpAddress
    from slipguard.daemon.api.paths import token_for

    return TcpAddress(before.url, token_for(before.url, before.token_file))


@contextmanager
def _client(context: typer.Context, socket: Path | None) -> Iterator[Client]:
    from slipguard.daemon.api.client import Client

    with Client(_address(context, socket)) as client:
        yield client


def _add_request(kind: str, example: str, question: str = "") -> None:
    """Add the command of a request: its fields are the options, its docstring is the help.

    question: asked before a request that must be confirmed, unless `--yes` is given.
    """
    model = REQUESTS[kind]

    def submit(context: typer.Context, socket: Path | None, json: bool, yes: bool = False, **fields: object) -> None:
        if question and not (yes or _confirm(question)):
            typer.echo(f"not done; `slipguard ctl {kind} --yes` does not ask", err=True)
            raise typer.Exit(1)
        if question:
            fields["confirm"] = True
        if "switch" in fields:
            fields["on"] = fields.pop("switch") is OnOff.on
        try:
            request = model.model_validate(fields)
        except ValidationError as invalid:
            field, _, reason = describe_validation_error(invalid, model).partition(" = ")
            raise typer.BadParameter(reason, ctx=context, param_hint=f"--{field.replace('_', '-')}") from None
        with _client(context, socket) as client:
            response = client.submit(request)
        if json:
            _print_json(response)
        else:
            typer.echo(response["message"])

    parameters = [parameter("context", typer.Context)]
    for name, field in model.model_fields.items():
        if name == "on":
            parameters.append(parameter("switch", Annotated[OnOff, typer.Argument(help=field.description)]))
        elif name != "confirm":
            parameters.append(field_option(name, field))
    parameters += [parameter("yes", YesOption, False)] if question else []
    parameters += [parameter("socket", SocketOption, None), parameter("json", JsonOption, False)]
    app.command(kind)(make_command(submit, f"{inspect.cleandoc(model.__doc__ or '')}\n\n{example}", parameters))


_add_request("grasp", "Example: `slipguard ctl grasp --force-n 30`, `slipguard ctl grasp --force-limit-n 45`")
_add_request("lift", "Example: `slipguard ctl lift --height-mm 120`")
_add_request("lower", "Example: `slipguard ctl lower`")
_add_request("stop", "Example: `slipguard ctl stop`")
_add_request("guard", "Example: `slipguard ctl guard on`")
_add_request("gripper", "Example: `slipguard ctl gripper --width-mm 60`")
_add_request("release", "Example: `slipguard ctl release --yes`", RELEASE_QUESTION)
_add_request(
    "activate", "Example: `slipguard ctl activate`, for programs `slipguard ctl activate --yes`", ACTIVATION_QUESTION
)
_add_request("clear", "Example: `slipguard ctl clear`")
_add_request("calibrate", "Example: `slipguard ctl calibrate`, `slipguard ctl calibrate --new-gel`")


def _print_json(response: dict[str, Any]) -> None:
    import json

    typer.echo(json.dumps(response))
