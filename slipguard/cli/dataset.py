"""`slipguard dataset`: images with contact masks, to train networks on: rendered, imported or recorded."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.options import ClusterOption, JobsOption, SocketOption
from slipguard.cli.terminal import count_bar
from slipguard.errors import InputError

if TYPE_CHECKING:
    from slipguard.config import Config
    from slipguard.daemon.api.client import Client
    from slipguard.datasets.recorder import Reader

app = typer.Typer(no_args_is_help=True, rich_markup_mode="markdown")
Out = Annotated[Path, typer.Option(help="Folder to write to: new or empty.")]
Sheet = Annotated[Path | None, typer.Option("--show", help="Write an overview of some frames to this PNG.")]
BACKGROUND_HELP = "Background image (no contact) of the sensor, 240 wide x 320 high."


class Split(StrEnum):
    """Set of objects."""

    train = "train"
    test = "test"


@app.callback()
def dataset() -> None:
    """Make data sets of images with contact masks, to train networks on.

    Example: `slipguard dataset render --out frames --count 200 --show sheet.png`
    """


@app.command()
def render(
    out: Out,
    count: Annotated[int, typer.Option(min=1, help="Number of frames.")],
    seed: Annotated[int, typer.Option(min=0, help="Random seed of the first frame; frame k uses this plus k.")] = 0,
    split: Annotated[
        Split, typer.Option(help="Training objects, or test objects that no network was trained on.")
    ] = Split.train,
    backgrounds: Annotated[
        Path | None,
        typer.Option(help="Folder of real background images, 240 wide x 320 high, for half of the simulated sensors."),
    ] = None,
    show: Sheet = None,
    jobs: JobsOption = 0,
    cluster: ClusterOption = None,
) -> None:
    """Render frames with their background images, masks and a manifest.

    Example: `slipguard dataset render --out frames --count 200 --split test --show sheet.png`
    """
    from slipguard.datasets.dataset_files import check_new, contact_sheet, read_backgrounds, render_dataset
    from slipguard.tools.parallel import Workers

    check_new(out)
    workers = Workers(jobs, cluster)
    real = read_backgrounds(backgrounds) if backgrounds is not None else None
    with count_bar("rendering", count) as show_count:
        render_dataset(out, count, seed, split.value, real, show_count, workers)
    if show is not None:
        contact_sheet(out, show)
    print(f"{count} frames in {out}" + (f", overview in {show}" if show is not None else ""))


@app.command(name="import")
def import_(
    source: Annotated[Path, typer.Argument(help="Folder of images and masks.")],
    out: Out,
    background: Annotated[Path | None, typer.Option(help=BACKGROUND_HELP)] = None,
    skip: Annotated[
        bool, typer.Option("--skip", help="Skip files that have no partner or cannot be read; else they are an error.")
    ] = False,
    show: Sheet = None,
    jobs: JobsOption = 0,
    cluster: ClusterOption = None,
) -> None:
    """Convert a folder of images and masks to a data set.

    Two layouts are known, also below train/ or val/: images/ and masks/ with the same names, or NAME.png and
    NAME_mask.png in one folder. Masks are 0 and 1, or 0 and 255. Images are scaled to 240 wide x 320 high.

    Example: `slipguard dataset import recordings --out frames --show sheet.png`
    """
    from slipguard.datasets.dataset_files import check_new, contact_sheet, read_background
    from slipguard.datasets.importer import found_pairs, import_dataset
    from slipguard.tools.parallel import Workers

    background_image = read_background(background) if background is not None else None
    check_new(out)
    found_pairs(source)
    with count_bar("importing") as show_count:
        done = import_dataset(source, out, background_image, skip, show_count, Workers(jobs, cluster))
    if show is not None:
        contact_sheet(out, show)
    notes = [f"{done.frames} frames in {out}"]
    notes += [f"{done.rotated} rotated upright"] if done.rotated else []
    notes += [f"{done.stretched} stretched to 3:4"] if done.stretched else []
    notes += [f"{len(done.left_out)} skipped, the first: {done.left_out[0]}"] if done.left_out else []
    print("; ".join(notes) + (f"; overview in {show}" if show is not None else ""))


@app.command()
def show(
    folder: Annotated[Path, typer.Argument(help="A data set: rendered, imported or recorded.")],
    out: Annotated[Path, typer.Option(help="PNG to write.")],
) -> None:
    """Write an overview of some frames of a data set, each with and without its mask.

    Example: `slipguard dataset show frames --out sheet.png`
    """
    from slipguard.datasets.dataset_files import contact_sheet

    contact_sheet(folder, out)
    print(f"overview in {out}")


@app.command()
def record(
    out: Out,
    config: Annotated[Path | None, typer.Option(help="Configuration: both fingers are recorded.")] = None,
    serial: Annotated[str | None, typer.Option(help="Record one DIGIT instead, by its serial number.")] = None,
    count: Annotated[int, typer.Option(min=1, help="Number of frames.")] = 100,
    every_s: Annotated[float, typer.Option(min=0.0, max=60.0, help="Seconds between frames.")] = 0.2,
    background: Annotated[Path | None, typer.Option(help=f"{BACKGROUND_HELP} Default: the stored one.")] = None,
    show: Sheet = None,
    socket: SocketOption = None,
) -> None:
    """Record frames with the masks that the network proposes. Correct them before training.

    A running daemon provides the frames; without one, this command opens the sensors.

    Example: `slipguard dataset record --serial D20479 --out presses --count 50 --show sheet.png`
    """
    import asyncio
    from contextlib import AsyncExitStack, aclosing

    from slipguard.cli.interrupt import default_interrupts
    from slipguard.config import read_config
    from slipguard.daemon.api.client import Client, DaemonNotRunning
    from slipguard.daemon.api.paths import running_socket
    from slipguard.datasets.dataset_files import check_new, contact_sheet
    from slipguard.datasets.recorder import images_of, opened, record_dataset, sensor_reader

    if (config is None) == (serial is None):
        raise InputError("give either --config config.toml or --serial D20479")
    check_new(out)
    settings = read_config(config) if config is not None else None

    async def record_all(client: Client | None) -> int:
        async with AsyncExitStack() as stack:
            if client is not None:
                readers, serials = _daemon_readers(client, serial)
            else:
                sensors = _sensors(settings, serial)
                # A missing image is reported before a sensor is opened, if the serial number is already known.
                _read_backgrounds([sensor.serial for sensor in sensors if sensor.serial], background, settings)
                await stack.enter_async_context(opened(sensors))
                readers, serials = [sensor_reader(one) for one in sensors], [sensor.serial for sensor in sensors]
            backgrounds = _read_backgrounds(serials, background, settings)
            show_count = stack.enter_context(count_bar("recording", count))
            async with aclosing(images_of(readers, every_s)) as images:
                return await record_dataset(out, images, count, backgrounds, show_count)

    with Client(socket or running_socket(settings)) as client:
        try:
            client.state()
            daemon: Client | None = client
        except DaemonNotRunning:
            daemon = None
        with default_interrupts():
            with_contact = asyncio.run(record_all(daemon))
    if show is not None:
        contact_sheet(out, show)
    print(f"{count} frames in {out}, {with_contact} with contact; check the masks before you train on them")


def _daemon_readers(client: Client, serial: str | None) -> tuple[list[Reader], list[str]]:
    """Return readers of the daemon's sensors, and their serial numbers. Raises InputError if it has no such sensor."""
    from slipguard.datasets.recorder import daemon_reader

    serials = {name: finger["serial"] for name, finger in client.state()["fingers"].items()}
    fingers = [name for name, one in serials.items() if one is not None and serial in (None, one)]
    if not fingers:
        known = ", ".join(one for one in serials.values() if one) or "none yet"
        raise InputError(
            f"the running daemon has no {serial or 'sensor'} (it has {known}); stop the daemon or record one of those"
        )
    return [daemon_reader(client, name) for name in fingers], [serials[name] for name in fingers]


def _sensors(settings: Config | None, serial: str | None) -> list[Any]:
    """Return the configured sensors, or one DIGIT, not opened."""
    from pydantic import ValidationError

    from slipguard.config_errors import describe_validation_error
    from slipguard.devices import FINGERS, DriverContext
    from slipguard.registry import build_device, load_driver

    group = "slipguard.tactile"
    sensors: list[Any] = []
    if settings is None:
        driver = load_driver(group, "digit")
        try:
            digit_settings = driver.Settings.model_validate({"serial": serial})
        except ValidationError as error:
            raise InputError(f"--{describe_validation_error(error, driver.Settings)}") from None
        sensors.append(driver(digit_settings, DriverContext("sensor")))
    else:
        for name in FINGERS:
            section = getattr(settings, name)
            sensors.append(build_device(group, section.driver, section.settings, DriverContext(name)))
    return sensors


def _read_backgrounds(serials: list[str], given: Path | None, settings: Config | None) -> dict[str, Any]:
    """Return the background image of each sensor. Raises InputError if one is missing."""
    from slipguard.daemon.store.state_dir import StateDir
    from slipguard.datasets.dataset_files import read_background

    if given is not None:
        return dict.fromkeys(serials, read_background(given))
    store = StateDir(settings.state.directory if settings is not None else None)
    found = {}
    for serial in serials:
        known = store.load_background(serial)
        if known is None:
            raise InputError(
                f"{store.path} has no background image of {serial}; run `slipguard calibrate` with the jaws open and "
                "empty, or give one with --background"
            )
        found[serial] = known.image
    return found
