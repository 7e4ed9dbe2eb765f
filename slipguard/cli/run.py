"""`slipguard run`, `slipguard check` and `slipguard version`."""

from __future__ import annotations

import asyncio
import faulthandler
import math
import os
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.interrupt import default_interrupts
from slipguard.cli.options import USUAL_FILE, ConfigOption, JsonOption

if TYPE_CHECKING:
    from slipguard.config import Config
    from slipguard.daemon.run import ServeApi


def run(
    config: ConfigOption = USUAL_FILE,
    sim: Annotated[
        bool,
        typer.Option(
            "--sim",
            help="Use simulated devices; the file may be missing. State and recordings are stored where those of a "
            "real cell are: set state.directory if this machine also runs one.",
        ),
    ] = False,
    log_json: Annotated[
        bool | None,
        typer.Option("--log-json/--log-text", help="Format of the log. Default: text on a terminal, else JSON."),
    ] = None,
) -> None:
    """Run the daemon until SIGINT or SIGTERM. The grip is kept when it stops. SIGHUP reloads the configuration.

    Example: `slipguard run --config config.toml`, then in another terminal `slipguard ctl state`
    """
    from slipguard.config import read_config, sim_config
    from slipguard.daemon import log_setup as log
    from slipguard.daemon import run as root
    from slipguard.daemon.lifecycle import exit_if_stuck
    from slipguard.daemon.store.last_config import last_config_path, read_or_last

    problem = None
    if sim:
        settings = sim_config() if config == USUAL_FILE and not config.exists() else read_config(config, sim=True)
    else:
        settings, problem = read_or_last(lambda: _read_checked(config), last_config_path())
    log.configure(json_lines=log_json)
    log.set_level(settings.log.level)
    if sim:
        from slipguard.sim_lifts.sim_daemon import run_simulated_cell

        daemon = run_simulated_cell(settings, bind_api, exit_if_stuck)
    else:
        reread = partial(_read_checked, config)
        daemon = root.run(settings, bind_api, read_config=reread, on_stop=exit_if_stuck, config_problem=problem)
    if sys.__stderr__ is not None:
        faulthandler.enable(sys.__stderr__)  # shows where the loop hung if the systemd watchdog ends the daemon
    with default_interrupts():
        asyncio.run(daemon)


def bind_api(config: Config) -> ServeApi:
    """Claim the daemon's socket, and return what serves API and page on it.

    Raises SlipguardError if another daemon has the socket, ConfigError if it cannot be created.
    """
    from slipguard.daemon.api.paths import socket_path, token_path
    from slipguard.web.host import run_api
    from slipguard.web.sockets import bind

    unix = bind(socket_path(config))
    return lambda api, warning: run_api(api, unix, config.api.address, token_path(config), warning)


def check(
    config: ConfigOption = USUAL_FILE,
    json: Annotated[
        bool, typer.Option("--json", help="Print the complete configuration with defaults as JSON.")
    ] = False,
) -> None:
    """Check and explain a configuration. Does not access any device.

    Example: `slipguard check --config config.toml`
    """
    from rich.console import Console
    from rich.table import Table

    from slipguard.errors import ConfigError, ModelError
    from slipguard.perception.segmenter import Segmenter

    settings = _read_checked(config)
    try:
        segmenter = Segmenter(settings.perception.model)
    except ModelError as error:
        raise ConfigError(f"{config}: perception.model = {error}") from error
    if json:
        print(settings.model_dump_json(indent=2, serialize_as_any=True))
        return
    console = Console()
    table = Table("device", "driver", "settings", title=str(config), title_justify="left")
    for name in ("left", "right", "gripper", "arm"):
        device = getattr(settings, name)
        own = ", ".join(f"{key} = {value!r}" for key, value in device.settings.model_dump(mode="json").items())
        table.add_row(name, device.driver, own)
    console.print(table)
    guard = settings.guard
    console.print(
        f"mode {guard.mode!r}: first grip {guard.first_force_n:g} N per finger, force limit {guard.force_max_n:g} N, "
        f"{guard.no_estimate_force_n:g} N without a rotation estimate"
    )
    if not settings.arm.present:
        console.print("no arm: only the grip is guarded, and no arm is stopped when the object slips")
    _, gripper_max_n = _devices(settings)["gripper"].force_limits_n
    if gripper_max_n < guard.force_max_n:
        console.print(f"this gripper applies at most {gripper_max_n:g} N")
    if settings.warning is not None:
        console.print(f"warning: {settings.warning}", style="yellow")
    width, height = segmenter.input_size
    console.print(f"network {segmenter.path.name} at {width}×{height}, estimator {settings.perception.estimator!r}")
    console.print("the configuration is valid")


def _read_checked(path: Path) -> Config:
    """Return the configuration of a file. Raises ConfigError, also for problems that would appear only later."""
    from slipguard.config import read_config
    from slipguard.errors import ConfigError

    config = read_config(path)
    problem = next(_find_problems(config), None)
    if problem is not None:
        raise ConfigError(f"{path}: {problem}")
    return config


def _find_problems(config: Config) -> Iterator[str]:
    """Yield problems that would appear only when the daemon starts, or at the first grasp; opens no device."""
    from slipguard.daemon.api.paths import socket_path
    from slipguard.daemon.run import recordings_path
    from slipguard.daemon.store.state_dir import StateDir
    from slipguard.errors import SlipguardError, describe_error
    from slipguard.web.sockets import PATH_MAX_BYTES

    model = config.perception.model
    if model is not None and not model.is_file():
        yield f"perception.model = {model}: " + (
            "a folder; give the path of the .onnx file" if model.is_dir() else "no such file"
        )
    folders = {"state.directory": StateDir(config.state.directory).path}
    if config.recording.enabled:
        folders["recording.directory"] = recordings_path(config)
    folders["api.socket"] = socket_path(config).parent
    for key, folder in folders.items():
        there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
        if not there.is_dir():
            yield f"{key}: {there} is not a folder; move it, or set {key} to another path"
    if socket_path(config).is_dir():
        yield f"api.socket = {socket_path(config)}: a folder; give the path of a file"
    if len(os.fsencode(socket_path(config))) > PATH_MAX_BYTES:
        yield f"api.socket = {socket_path(config)}: longer than {PATH_MAX_BYTES} bytes, the maximum of a Unix socket"
    try:
        gripper_min_n, gripper_max_n = _devices(config)["gripper"].force_limits_n
        valid = 0.0 <= gripper_min_n < gripper_max_n < math.inf
    except SlipguardError as error:
        yield str(error)
        return
    except Exception as error:
        yield f"gripper: driver {config.gripper.driver!r}: force_limits_n: {describe_error(error)}; correct the driver"
        return
    if not valid:
        yield (
            f"gripper: driver {config.gripper.driver!r}: force_limits_n is {gripper_min_n:g} to {gripper_max_n:g} N; "
            "the driver must give a lowest and a higher force"
        )
    if config.guard.force_max_n < gripper_min_n:
        limit_n = config.guard.force_max_n
        yield f"guard.force_max_n = {limit_n:g}: the minimum force of this gripper is {gripper_min_n:g} N"


def _devices(config: Config) -> dict[str, Any]:
    """Return all four drivers with their settings, not opened. Raises SlipguardError for invalid settings."""
    from slipguard.config import GROUP_OF
    from slipguard.devices import DriverContext
    from slipguard.registry import build_device

    sections = {name: getattr(config, name) for name in GROUP_OF}
    return {
        name: build_device(
            GROUP_OF[name], section.driver, section.settings, DriverContext(name, mode=config.guard.mode)
        )
        for name, section in sections.items()
    }


def version(
    json: JsonOption = False,
) -> None:
    """Show the versions of slipguard, Python, libraries and drivers.

    Example: `slipguard version --json`
    """
    import json as jsonlib
    import platform
    from importlib.metadata import PackageNotFoundError
    from importlib.metadata import version as installed

    from rich.console import Console
    from rich.table import Table

    from slipguard import __version__
    from slipguard.registry import GROUPS, driver_names

    libraries: dict[str, str | None] = {}
    for name in (
        "numpy", "onnxruntime", "opencv-contrib-python-headless", "scikit-image", "pydantic",
        "structlog", "ur-rtde", "torch",
    ):  # fmt: skip
        try:
            libraries[name] = installed(name)
        except PackageNotFoundError:
            libraries[name] = None
    facts = {
        "slipguard": __version__,
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}",
        "libraries": libraries,
        "drivers": {group: driver_names(group) for group in GROUPS},
    }
    if json:
        print(jsonlib.dumps(facts))
        return
    table = Table(show_header=False)
    table.add_row("slipguard", __version__)
    table.add_row("python", platform.python_version())
    table.add_row("machine", str(facts["machine"]))
    for name, number in libraries.items():
        table.add_row(name, number or "not installed")
    for group in GROUPS:
        table.add_row(group, ", ".join(driver_names(group)))
    Console().print(table)
