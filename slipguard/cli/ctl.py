"""`slipguard ctl`: send requests to a running daemon."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.errors import InputError, SlipguardError

if TYPE_CHECKING:
    from slipguard.daemon.api.client import Client, TcpAddress

app = typer.Typer(
    no_args_is_help=True,
    help="Send requests to a running daemon. Exit code 1 with the daemon's reason if it refuses.\n\n"
    "Example: `slipguard ctl state`, `slipguard ctl grasp`, `slipguard ctl lift`, `slipguard ctl release --yes`",
)

SocketOption = Annotated[
    Path | None,
    typer.Option("--socket", help="Unix socket of the daemon. Default: this user's daemon, then the system's."),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the daemon's response as one JSON object.")]
ForceOption = Annotated[float | None, typer.Option(help="Newtons per finger. Default: from the configuration.")]
ForceLimitOption = Annotated[
    float | None,
    typer.Option(help="For a fragile object: newtons per finger that are never exceeded while it is held."),
]
HeightOption = Annotated[float | None, typer.Option(help="Millimeters. Default: from the configuration.")]
SpeedOption = Annotated[float | None, typer.Option(help="Millimeters per second. Default: from the configuration.")]
WidthOption = Annotated[float | None, typer.Option(help="Millimeters between the jaws.")]
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
def grasp(
    context: typer.Context,
    force_n: ForceOption = None,
    force_limit_n: ForceLimitOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Close gently on the object between the jaws.

    Example: `slipguard ctl grasp --force-n 30`, `slipguard ctl grasp --force-limit-n 45`
    """
    _submit(context, socket, json, "grasp", force_n=force_n, force_limit_n=force_limit_n)


@app.command()
def lift(
    context: typer.Context,
    height_mm: HeightOption = None,
    speed_mm_s: SpeedOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Lift the held object; returns when the lift has begun.

    Example: `slipguard ctl lift --height-mm 120`
    """
    _submit(context, socket, json, "lift", height_mm=height_mm, speed_mm_s=speed_mm_s)


@app.command()
def lower(
    context: typer.Context,
    height_mm: HeightOption = None,
    speed_mm_s: SpeedOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Lower the held object, by default by the height it was lifted; returns when the motion has begun.

    Example: `slipguard ctl lower`
    """
    _submit(context, socket, json, "lower", height_mm=height_mm, speed_mm_s=speed_mm_s)


@app.command()
def stop(context: typer.Context, socket: SocketOption = None, json: JsonOption = False) -> None:
    """Stop the arm at once and keep the grip, in every state. Nothing moves until the next request.

    A held object stays guarded: when it slips, the grip is tightened. Closing jaws are halted; a release goes on.

    Example: `slipguard ctl stop`
    """
    _submit(context, socket, json, "stop")


@app.command()
def guard(
    context: typer.Context,
    switch: Annotated[OnOff, typer.Argument(help="on: tighten when the object slips. off: only report.")],
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Switch the guard on or off.

    Example: `slipguard ctl guard on`
    """
    _submit(context, socket, json, "guard", on=switch is OnOff.on)


@app.command()
def gripper(
    context: typer.Context,
    width_mm: WidthOption = None,
    force_n: ForceOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Move the jaws for another program. Never opens on a held object and never lowers its grip force.

    Without --force-n, the force of the first grip is used. --width-mm may be omitted while an object is held. In lift
    mode an object gripped this way is not guarded until `slipguard ctl guard on`.

    Example: `slipguard ctl gripper --width-mm 60`
    """
    if width_mm is None and force_n is None:
        raise InputError("gripper: nothing to do; give --width-mm, --force-n or both")
    _submit(context, socket, json, "gripper", width_mm=width_mm, force_n=force_n)


@app.command()
def release(
    context: typer.Context,
    yes: YesOption = False,
    width_mm: WidthOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Open the jaws, in every state, including faults; they never close. A held object drops: support it first.

    A gripper that is not active, as after a loss of power, opens slowly and fully. It must then be activated.

    Example: `slipguard ctl release --yes`
    """
    if not yes and not _confirm(RELEASE_QUESTION):
        typer.echo("the jaws were not opened; with --yes the command does not ask", err=True)
        raise typer.Exit(1)
    _submit(context, socket, json, "release", confirm=True, width_mm=width_mm)


@app.command()
def activate(
    context: typer.Context,
    yes: YesOption = False,
    force: Annotated[
        bool, typer.Option("--force", help="Also if a finger sees contact: the gels are covered or taken off.")
    ] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Activate the gripper, as each time after it was switched on. Refused while an object may be held.

    The jaws open and close fully, at full speed and force, and press the gels against each other: take the gels off
    their sensors first, or tie something soft over each. Empty the jaws and keep your hands out.

    Example: `slipguard ctl activate`, for programs `slipguard ctl activate --yes`
    """
    if not yes and not _confirm(ACTIVATION_QUESTION):
        typer.echo("the gripper was not activated; `slipguard ctl activate --yes` does not ask", err=True)
        raise typer.Exit(1)
    _submit(context, socket, json, "activate", confirm=True, force=force)


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
def clear(context: typer.Context, socket: SocketOption = None, json: JsonOption = False) -> None:
    """Clear a latched fault whose cause is gone; a held object stays held.

    Example: `slipguard ctl clear`
    """
    _submit(context, socket, json, "clear")


@app.command()
def calibrate(
    context: typer.Context,
    force: Annotated[bool, typer.Option("--force", help="Also if the stored image indicates contact.")] = False,
    new_gel: Annotated[
        bool, typer.Option("--new-gel", help="The gels were replaced: count wear from this image on.")
    ] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Take and store the background image of each finger. The jaws must be open and empty.

    Example: `slipguard ctl calibrate`, `slipguard ctl calibrate --new-gel`
    """
    _submit(context, socket, json, "calibrate", force=force, new_gel=new_gel)


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


def _submit(context: typer.Context, socket: Path | None, json: bool, kind: str, **fields: object) -> None:
    """Submit a request of `slipguard.daemon.api.requests` and print the response."""
    from pydantic import ValidationError

    from slipguard.config_errors import describe_validation_error
    from slipguard.daemon.api.requests import REQUESTS

    model = REQUESTS[kind]
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


def _print_json(response: dict[str, Any]) -> None:
    import json

    typer.echo(json.dumps(response))
