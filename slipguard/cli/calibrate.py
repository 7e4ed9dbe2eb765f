"""`slipguard calibrate`: the no-contact images, taken, shown, compared and fetched back."""

from __future__ import annotations

import asyncio
import json as jsonlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.interrupt import left_to_the_loop
from slipguard.cli.run import USUAL_FILE, ConfigOption

if TYPE_CHECKING:
    from slipguard.config import Config
    from slipguard.daemon.api.client import Client

LOOK = "With --show, --plot and --back-to"
Stored = Mapping[str, Any]
"""What `GET /no-contact` answers: by finger, `serial` and `versions`."""


def calibrate(
    config: ConfigOption = USUAL_FILE,
    socket: Annotated[Path | None, typer.Option(help="Socket of a running daemon; default: found.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Even if the stored image says there is contact.")] = False,
    new_gel: Annotated[bool, typer.Option("--new-gel", help="Gels were replaced; wear counts from now on.")] = False,
    show: Annotated[
        bool, typer.Option("--show", help="Take nothing; show what is stored.", rich_help_panel=LOOK)
    ] = False,
    plot: Annotated[
        Path | None, typer.Option(help="Picture of the newest images and what has changed.", rich_help_panel=LOOK)
    ] = None,
    back_to: Annotated[
        int | None, typer.Option(min=1, help="Use this older image of --finger again.", rich_help_panel=LOOK)
    ] = None,
    finger: Annotated[str | None, typer.Option(help="left or right.", rich_help_panel=LOOK)] = None,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Store each finger's no-contact image, by serial; needed before the first grasp.

    Asks the running daemon; opens the sensors itself only when none runs. The jaws must be open and empty.
    Example: `slipguard calibrate --config config.toml`, `slipguard calibrate --show --plot gels.png`
    """
    from slipguard.config import read_config
    from slipguard.daemon import logging as log
    from slipguard.daemon.api.client import Client, DaemonNotRunning
    from slipguard.daemon.api.paths import running_socket
    from slipguard.errors import InputError

    if finger not in (None, "left", "right"):
        raise InputError(f"--finger {finger}: there are left and right")
    if (back_to is None) != (finger is None):
        raise InputError("--back-to and --finger go together, such as `--back-to 3 --finger left`")
    settings = read_config(config)
    log.configure(level=logging.WARNING)
    look_only = show or (plot is not None and back_to is None)
    try:
        with Client(socket or running_socket(settings)) as client:
            answer = _asked(client, look_only, force, new_gel, back_to, finger)
            stored: Stored = client.no_contacts()
            pictures = _pictures(client, stored) if plot is not None else {}
    except DaemonNotRunning:
        with left_to_the_loop():
            answer, stored, pictures = asyncio.run(_alone(settings, look_only, force, new_gel, back_to, finger))
    if plot is not None:
        from slipguard.tools.background_plot import draw

        draw(pictures, stored, plot)
    if json:
        print(jsonlib.dumps(answer | {"stored": stored}))
    else:
        _show(stored, every=show)
        print(answer.get("said") or (f"{plot} is written" if plot else "nothing was taken"))


def _asked(
    client: Client, look_only: bool, force: bool, new_gel: bool, back_to: int | None, finger: str | None
) -> dict[str, Any]:
    if look_only:
        return {}
    if back_to is not None and finger is not None:
        return client.go_back(finger, back_to)
    return client.calibrate(force=force, new_gel=new_gel)


async def _alone(
    settings: Config, look_only: bool, force: bool, new_gel: bool, back_to: int | None, finger: str | None
) -> tuple[dict[str, Any], Stored, dict[str, bytes]]:
    """The same without a daemon: it opens the sensors, where they must be looked at or tell their serial numbers."""
    from slipguard.daemon.api.handlers import RequestHandlers
    from slipguard.daemon.run import sensors_alone
    from slipguard.tools.background_plot import png_of

    async with sensors_alone(settings, look_only=look_only) as service:
        desk = RequestHandlers(service)
        answer: dict[str, Any] = {}
        if back_to is not None and finger is not None:
            answer = {"said": await desk.go_back(finger, back_to)}
        elif not look_only:
            answer = dict(await desk.calibrate(force, new_gel))
        stored: Stored = jsonlib.loads(await desk.no_contacts())
        pictures = {}
        for name, number in _wanted(stored):
            pictures[f"{name} {number}"] = png_of((await desk.no_contact(name, number)).frame.image)
        return answer, stored, pictures


def _wanted(stored: Stored) -> list[tuple[str, int]]:
    """The newest image of each finger, and the first of its gel."""
    wanted = []
    for name, told in stored.items():
        numbers = [one["number"] for one in told["versions"]]
        if numbers:
            first = max((one["number"] for one in told["versions"] if one["new_gel"]), default=numbers[0])
            wanted += [(name, number) for number in dict.fromkeys((first, numbers[-1]))]
    return wanted


def _pictures(client: Client, stored: Stored) -> dict[str, bytes]:
    """PNGs by finger and number."""
    return {f"{name} {number}": client.no_contact(name, number).png for name, number in _wanted(stored)}


def _show(stored: Stored, *, every: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("finger", "sensor", "image", "taken", "noise B G R", "light B G R", "since the one before")
    for name, told in stored.items():
        versions = told["versions"]
        if not versions:
            table.add_row(name, told["serial"] or "not seen yet", "none")
        first = 0 if every else len(versions) - 1
        for index, one in list(enumerate(versions))[first:]:
            before = versions[index - 1] if index else None
            table.add_row(
                name if index == first else "",
                told["serial"] if index == first else "",
                _number(one),
                one["created_at"][:16].replace("T", " "),
                _levels(one["noise_bgr"], ".1f"),
                _levels(one["level_bgr"], ".0f"),
                _since(one, before),
            )
    Console(highlight=False).print(table)


def _number(one: Mapping[str, Any]) -> str:
    notes = ["new gel"] * one["new_gel"] + ([f"= {one['copy_of']}"] if one["copy_of"] else [])
    return f"{one['number']} ({', '.join(notes)})" if notes else str(one["number"])


def _levels(levels: list[float] | None, form: str) -> str:
    return "?" if levels is None else " ".join(format(level, form) for level in levels)


def _since(one: Mapping[str, Any], before: Mapping[str, Any] | None) -> str:
    if before is None or one["level_bgr"] is None or before["level_bgr"] is None:
        return ""
    return _levels([now - then for now, then in zip(one["level_bgr"], before["level_bgr"], strict=True)], "+.1f")
