"""`slipguard calibrate`: take, show, compare and restore the background images."""

from __future__ import annotations

import asyncio
import json as jsonlib
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.options import USUAL_FILE, ConfigOption, JsonOption, SocketOption

if TYPE_CHECKING:
    from slipguard.config import Config
    from slipguard.daemon.api.client import Client
    from slipguard.daemon.api.requests import DaemonRequest

STORED_IMAGES_PANEL = "Stored images"
StoredImages = Mapping[str, Any]
"""Response to `GET /background`: by finger, `serial` and `versions`."""


def calibrate(
    config: ConfigOption = USUAL_FILE,
    socket: SocketOption = None,
    force: Annotated[bool, typer.Option("--force", help="Also if the stored image indicates contact.")] = False,
    new_gel: Annotated[
        bool, typer.Option("--new-gel", help="The gels were replaced: count wear from this image on.")
    ] = False,
    show: Annotated[
        bool,
        typer.Option("--show", help="Show all stored images; take none.", rich_help_panel=STORED_IMAGES_PANEL),
    ] = False,
    plot: Annotated[
        Path | None,
        typer.Option(
            help="Write the newest images and their changes to this PNG; take none.",
            rich_help_panel=STORED_IMAGES_PANEL,
        ),
    ] = None,
    back_to: Annotated[
        int | None,
        typer.Option(min=1, help="Use this older image of --finger again.", rich_help_panel=STORED_IMAGES_PANEL),
    ] = None,
    finger: Annotated[str | None, typer.Option(help="left or right.", rich_help_panel=STORED_IMAGES_PANEL)] = None,
    json: JsonOption = False,
) -> None:
    """Store a background image (no contact) of each finger. Needed before the first grasp.

    The jaws must be open and empty. A running daemon takes the images; without one, this command opens the sensors.

    Example: `slipguard calibrate --config config.toml`, `slipguard calibrate --show --plot gels.png`
    """
    from slipguard.config import read_config
    from slipguard.daemon import log_setup as log
    from slipguard.daemon.api.client import Client, DaemonNotRunning
    from slipguard.daemon.api.paths import running_socket
    from slipguard.daemon.api.requests import CalibrateRequest, RestoreBackgroundRequest
    from slipguard.errors import InputError

    if finger not in (None, "left", "right"):
        raise InputError(f"--finger {finger}: choose left or right")
    if (back_to is None) != (finger is None):
        raise InputError("--back-to and --finger go together, such as `--back-to 3 --finger left`")
    settings = read_config(config)
    log.configure(level=logging.WARNING)
    request: DaemonRequest | None = CalibrateRequest(force=force, new_gel=new_gel)
    if back_to is not None:
        request = RestoreBackgroundRequest.model_validate({"finger": finger, "number": back_to})
    elif show or plot is not None:
        request = None
    try:
        with Client(socket or running_socket(settings)) as client:
            response = client.submit(request) if request is not None else {}
            stored: StoredImages = client.backgrounds()
            images = _read_images(client, stored) if plot is not None else {}
    except DaemonNotRunning:
        with default_interrupts():
            response, stored, images = asyncio.run(_without_daemon(settings, request))
    if plot is not None:
        from slipguard.tools.background_plot import draw

        draw(images, stored, plot)
    if json:
        print(jsonlib.dumps(response | {"stored": stored}))
    else:
        _print_table(stored, every=show)
        print(response.get("message") or (f"wrote {plot}" if plot else "no images were taken"))


async def _without_daemon(
    settings: Config, request: DaemonRequest | None
) -> tuple[dict[str, Any], StoredImages, dict[str, bytes]]:
    """Do the same without a daemon: opens the sensors if they are needed."""
    from slipguard.daemon.api.handlers import RequestHandlers
    from slipguard.daemon.run import sensors_without_daemon
    from slipguard.tools.background_plot import png_of

    async with sensors_without_daemon(settings, stored_only=request is None) as service:
        handlers = RequestHandlers(service)
        response = dict(await handlers.submit(request)) if request is not None else {}
        stored: StoredImages = jsonlib.loads(await handlers.backgrounds())
        images = {
            f"{name} {number}": png_of((await handlers.background(name, number)).frame.image)
            for name, number in _compared_images(stored)
        }
        return response, stored, images


def _compared_images(stored: StoredImages) -> list[tuple[str, int]]:
    """Return finger and number of the newest image of each finger, and of the first of its gel."""
    images = []
    for name, finger in stored.items():
        numbers = [one["number"] for one in finger["versions"]]
        if numbers:
            first = max((one["number"] for one in finger["versions"] if one["new_gel"]), default=numbers[0])
            images += [(name, number) for number in dict.fromkeys((first, numbers[-1]))]
    return images


def _read_images(client: Client, stored: StoredImages) -> dict[str, bytes]:
    """Return PNGs by finger and number."""
    return {f"{name} {number}": client.background(name, number).png for name, number in _compared_images(stored)}


def _print_table(stored: StoredImages, *, every: bool) -> None:
    from rich.console import Console
    from rich.table import Table

    table = Table("finger", "sensor", "image", "taken", "noise B G R", "brightness B G R", "change of brightness")
    for name, finger in stored.items():
        versions = finger["versions"]
        if not versions:
            table.add_row(name, finger["serial"] or "not found yet", "none")
        first = 0 if every else len(versions) - 1
        for index, one in list(enumerate(versions))[first:]:
            before = versions[index - 1] if index else None
            table.add_row(
                name if index == first else "",
                finger["serial"] if index == first else "",
                _number_text(one),
                one["created_at"][:16].replace("T", " "),
                _levels_text(one["noise_bgr"], ".1f"),
                _levels_text(one["level_bgr"], ".0f"),
                _change_text(one, before),
            )
    Console(highlight=False).print(table)


def _number_text(one: Mapping[str, Any]) -> str:
    notes = ["new gel"] * one["new_gel"] + ([f"copy of {one['copy_of']}"] if one["copy_of"] else [])
    return f"{one['number']} ({', '.join(notes)})" if notes else str(one["number"])


def _levels_text(levels: list[float] | None, form: str) -> str:
    return "?" if levels is None else " ".join(format(level, form) for level in levels)


def _change_text(one: Mapping[str, Any], before: Mapping[str, Any] | None) -> str:
    if before is None or one["level_bgr"] is None or before["level_bgr"] is None:
        return ""
    return _levels_text([now - then for now, then in zip(one["level_bgr"], before["level_bgr"], strict=True)], "+.1f")
