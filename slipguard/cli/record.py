"""`slipguard dataset record`: a data set from a sensor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    from collections.abc import AsyncIterator

    from slipguard.config import Config
    from slipguard.daemon.api.client import Client
    from slipguard.datasets.recorder import SensorImage


def record(
    out: Annotated[Path, typer.Option(help="Folder to write to: new or empty.")],
    config: Annotated[Path | None, typer.Option(help="The configuration: both fingers are recorded.")] = None,
    serial: Annotated[str | None, typer.Option(help="One DIGIT instead, by its serial number.")] = None,
    count: Annotated[int, typer.Option(min=1, help="How many frames.")] = 100,
    every_s: Annotated[float, typer.Option(min=0.0, max=60.0, help="Seconds between them.")] = 0.2,
    background: Annotated[
        Path | None, typer.Option(help="No-contact image in place of the stored one, 240 wide x 320 high.")
    ] = None,
    show: Annotated[Path | None, typer.Option(help="Write a sheet of some frames to this PNG.")] = None,
    socket: Annotated[Path | None, typer.Option(help="Socket of a running daemon; default: found.")] = None,
) -> None:
    """Record frames with proposed labels: what differs from the no-contact image. Correct them before you train.

    A running daemon is asked for its frames; the sensors are opened only where none runs.

    Example: `slipguard dataset record --serial D20479 --out presses --count 50 --show sheet.png`
    """
    import asyncio

    from slipguard.cli.interrupt import default_interrupts
    from slipguard.cli.progress import count_bar
    from slipguard.config import read_config
    from slipguard.daemon.api.client import Client, DaemonNotRunning
    from slipguard.daemon.api.paths import running_socket
    from slipguard.datasets.contact_sheet import contact_sheet
    from slipguard.datasets.files import check_new
    from slipguard.datasets.recorder import record_dataset
    from slipguard.errors import InputError

    if (config is None) == (serial is None):
        raise InputError("name what to record: either --config config.toml or --serial D20479")
    check_new(out)
    settings = read_config(config) if config is not None else None

    async def all_of_it(client: Client | None) -> int:
        shots, serials = _daemons(client, serial, every_s) if client else _own(settings, serial, every_s)
        backgrounds = _backgrounds(serials, background, settings)
        with count_bar("recording", count) as show_count:
            try:
                return await record_dataset(out, shots, count, backgrounds, show_count)
            finally:
                await shots.aclose()  # type: ignore[attr-defined]

    with Client(socket or running_socket(settings)) as client:
        try:
            client.state()
            asked: Client | None = client
        except DaemonNotRunning:
            asked = None
        with default_interrupts():
            touched = asyncio.run(all_of_it(asked))
    if show is not None:
        contact_sheet(out, show)
    print(f"{count} frames in {out}, {touched} with contact; look at the labels before you train on them")


def _daemons(client: Client, serial: str | None, every_s: float) -> tuple[AsyncIterator[SensorImage], list[str]]:
    """What a daemon sees; raises InputError where it has no such sensor."""
    from slipguard.datasets.recorder import from_daemon
    from slipguard.errors import InputError

    serials = {name: finger["serial"] for name, finger in client.state()["fingers"].items()}
    fingers = [name for name, its in serials.items() if its is not None and serial in (None, its)]
    if not fingers:
        there = ", ".join(its for its in serials.values() if its) or "none yet"
        raise InputError(
            f"a daemon runs and has no {serial or 'sensor'} (it has {there}); stop it or record one of those"
        )
    return from_daemon(client, fingers, every_s), [serials[name] for name in fingers]


def _own(settings: Config | None, serial: str | None, every_s: float) -> tuple[AsyncIterator[SensorImage], list[str]]:
    """The configured sensors, or one DIGIT."""
    from pydantic import ValidationError

    from slipguard.config_errors import first_complaint
    from slipguard.datasets.recorder import from_sensors
    from slipguard.devices import DriverContext
    from slipguard.errors import InputError
    from slipguard.registry import load_driver

    group = "slipguard.tactile"
    sensors: list[Any] = []
    if settings is None:
        driver = load_driver(group, "digit")
        try:
            alone = driver.Settings.model_validate({"serial": serial})
        except ValidationError as error:
            raise InputError(f"--{first_complaint(error, driver.Settings)}") from None
        sensors.append(driver(alone, DriverContext("sensor")))
    else:
        for name in ("left", "right"):
            section = getattr(settings, name)
            sensors.append(load_driver(group, section.driver)(section.settings, DriverContext(name)))
    return from_sensors(sensors, every_s), [sensor.serial for sensor in sensors]


def _backgrounds(serials: list[str], given: Path | None, settings: Config | None) -> dict[str, Any]:
    """The no-contact image of every sensor; raises InputError where one is missing."""
    from slipguard.daemon.store.state_dir import StateDir
    from slipguard.datasets.files import read_background
    from slipguard.errors import InputError

    if given is not None:
        return dict.fromkeys(serials, read_background(given))
    store = StateDir(settings.state.directory if settings is not None else None)
    found = {}
    for serial in serials:
        known = store.load_background(serial)
        if known is None:
            raise InputError(
                f"{store.path} holds no no-contact image of {serial}; jaws open and empty: `slipguard calibrate`, "
                "or name one with --background"
            )
        found[serial] = known.image
    return found
