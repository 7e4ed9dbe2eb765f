"""`slipguard ctl`: talk to a running daemon."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
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
    help="Talk to a running daemon. Exit code 1 with the daemon's reason where it refuses.\n\n"
    "Example: `slipguard ctl state`, `slipguard ctl grasp`, `slipguard ctl lift`, `slipguard ctl release --yes`",
)

SocketOption = Annotated[
    Path | None, typer.Option("--socket", help="Unix socket of the daemon; default: that of this user or system.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="The daemon's answer as one JSON object.")]
ForceOption = Annotated[float | None, typer.Option(min=0.1, max=235.0, help="Newtons per finger.")]
HeightOption = Annotated[float | None, typer.Option(min=0.1, max=2000.0, help="Millimetres.")]
SpeedOption = Annotated[float | None, typer.Option(min=0.1, max=250.0, help="Millimetres a second.")]
WidthOption = Annotated[float | None, typer.Option(min=0.0, max=200.0, help="Millimetres between the jaws.")]


class Switch(StrEnum):
    """on or off."""

    on = "on"
    off = "off"


@dataclass(frozen=True, slots=True)
class _Told:
    """What stood between `ctl` and the command."""

    socket: Path | None
    url: str | None
    token_file: Path | None


@app.callback()
def whom(
    context: typer.Context,
    socket: SocketOption = None,
    url: Annotated[
        str | None, typer.Option(help="Ask over TCP, such as http://127.0.0.1:8470, and not over the Unix socket.")
    ] = None,
    token_file: Annotated[
        Path | None,
        typer.Option(help="The daemon's token, for --url; default: that of this user or system, on this machine."),
    ] = None,
) -> None:
    """Keep whom to ask for the command that follows."""
    if token_file is not None and url is None:
        raise InputError("--token-file is for --url; the Unix socket asks for no token")
    context.obj = _Told(socket, url, token_file)


@app.command()
def state(context: typer.Context, socket: SocketOption = None, json: JsonOption = False) -> None:
    """Show what is held, how each device is, and what to do about a fault; `--json` has everything.

    Example: `slipguard ctl state`
    """
    with _client(_where(context, socket)) as client:
        answer = client.state()
    if json:
        _print_json(answer)
        return
    from rich.console import Console

    from slipguard.cli.state_view import view

    Console(highlight=False).print(view(answer))


@app.command()
def grasp(
    context: typer.Context, force_n: ForceOption = None, socket: SocketOption = None, json: JsonOption = False
) -> None:
    """Close on what is between the jaws, gently.

    Example: `slipguard ctl grasp --force-n 30`
    """
    _ask(_where(context, socket), json, lambda client: client.grasp(force_n))


@app.command()
def lift(
    context: typer.Context,
    height_mm: HeightOption = None,
    speed_mm_s: SpeedOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Lift what is held; returns when the lift has begun.

    Example: `slipguard ctl lift --height-mm 120`
    """
    _ask(_where(context, socket), json, lambda client: client.lift(height_mm, speed_mm_s))


@app.command()
def lower(
    context: typer.Context,
    height_mm: HeightOption = None,
    speed_mm_s: SpeedOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Lower what is held, by as much as it was lifted; returns when the motion has begun.

    Example: `slipguard ctl lower`
    """
    _ask(_where(context, socket), json, lambda client: client.lower(height_mm, speed_mm_s))


@app.command()
def guard(
    context: typer.Context,
    switch: Annotated[Switch, typer.Argument(help="on: tighten when the object slips. off: only watch.")],
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Guard what is held, or stop guarding.

    Example: `slipguard ctl guard on`
    """
    _ask(_where(context, socket), json, lambda client: client.guard(switch is Switch.on))


@app.command()
def gripper(
    context: typer.Context,
    width_mm: WidthOption = None,
    force_n: ForceOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Move the jaws for another program; never opens a held object, never lowers its grip.

    Without --force-n with the force of the first grip; --width-mm may be left out where something is held. In lift mode
    what the jaws meet is not guarded until `slipguard ctl guard on`.
    Example: `slipguard ctl gripper --width-mm 60`
    """
    if width_mm is None and force_n is None:
        raise InputError("say what the jaws shall do: give --width-mm, --force-n or both")
    _ask(_where(context, socket), json, lambda client: client.gripper(width_mm, force_n))


@app.command()
def release(
    context: typer.Context,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask.")] = False,
    width_mm: WidthOption = None,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Open the jaws, in every state, faults included: what is held drops.

    Example: `slipguard ctl release --yes`
    """
    if not yes and not _sure("Open the jaws? What is held drops."):
        typer.echo("nothing was opened; `slipguard ctl release --yes` does not ask", err=True)
        raise typer.Exit(1)
    _ask(_where(context, socket), json, lambda client: client.release(width_mm))


@app.command()
def clear(context: typer.Context, socket: SocketOption = None, json: JsonOption = False) -> None:
    """Leave a fault whose cause is gone; what is held stays held.

    Example: `slipguard ctl clear`
    """
    _ask(_where(context, socket), json, lambda client: client.clear())


@app.command()
def calibrate(
    context: typer.Context,
    force: Annotated[
        bool, typer.Option("--force", help="Even if the stored image says that there is contact.")
    ] = False,
    new_gel: Annotated[bool, typer.Option("--new-gel", help="Gels were replaced; wear counts from now on.")] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Take and store each finger's no-contact image; the jaws must be open and empty.

    Example: `slipguard ctl calibrate`, `slipguard ctl calibrate --new-gel`
    """
    _ask(_where(context, socket), json, lambda client: client.calibrate(force=force, new_gel=new_gel))


@app.command()
def page(
    context: typer.Context,
    open_it: Annotated[bool, typer.Option("--open", help="Open it in this machine's browser.")] = False,
    socket: SocketOption = None,
    json: JsonOption = False,
) -> None:
    """Make a link to the operator page that gives the browser that opens it first control; it is good for a minute.

    Without a link the page only shows. As root, which no browser runs as, open the printed link in your own browser.
    Example: `slipguard ctl page --open`
    """
    if open_it and os.geteuid() == 0:
        raise InputError("--open: no browser runs as root; leave --open out and open the link in your own browser")
    with _client(_where(context, socket)) as client:
        answer = client.page_link()
    if json:
        _print_json(answer)
    else:
        typer.echo(answer["url"])
    if open_it:
        import webbrowser

        if not webbrowser.open(str(answer["url"])):
            raise SlipguardError("no browser could be started here; open the link in one within a minute")


def _sure(question: str) -> bool:
    """A person's yes; anything else, the end of the input and Ctrl-C included, is a no."""
    try:
        return typer.confirm(question, err=True)
    except typer.Abort:
        typer.echo(err=True)
        return False


def _where(context: typer.Context, socket: Path | None) -> Path | TcpAddress | None:
    """Whom to ask: what stands after the command counts before what stands after `ctl`; None: whoever runs here."""
    before: _Told = context.obj
    if before.url is None:
        return socket or before.socket
    if socket or before.socket:
        raise InputError("--url and --socket: one daemon at a time; leave one of them out")
    from slipguard.daemon.api.client import TcpAddress
    from slipguard.daemon.api.paths import token_for

    return TcpAddress(before.url, token_for(before.url, before.token_file))


@contextmanager
def _client(where: Path | TcpAddress | None) -> Iterator[Client]:
    from slipguard.daemon.api.client import Client

    with Client(where) as client:
        yield client


def _ask(where: Path | TcpAddress | None, json: bool, command: Callable[[Client], dict[str, Any]]) -> None:
    with _client(where) as client:
        answer = command(client)
    if json:
        _print_json(answer)
    else:
        typer.echo(answer.get("said", "done"))


def _print_json(answer: dict[str, Any]) -> None:
    import json

    typer.echo(json.dumps(answer))
