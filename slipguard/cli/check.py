"""`slipguard check`: every mistake in a configuration, and what its keys mean."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from slipguard.cli.options import USUAL_FILE, ConfigOption

if TYPE_CHECKING:
    from slipguard.config import Config


def check(
    config: ConfigOption = USUAL_FILE,
    json: Annotated[
        bool, typer.Option("--json", help="Print the complete configuration with defaults as JSON.")
    ] = False,
    explain: Annotated[
        str | None, typer.Option(metavar="KEY", help="Explain one key, or the keys of a table, instead.")
    ] = None,
) -> None:
    """Check a configuration and report all mistakes, or explain its keys. Does not access any device.

    Example: `slipguard check --config config.toml`, `slipguard check --explain guard.tuning`
    """
    from rich.console import Console
    from rich.table import Table

    from slipguard.config_help import explain_key
    from slipguard.errors import ConfigError, ModelError
    from slipguard.perception.segmenter import Segmenter

    if explain is not None:
        print("\n".join(explain_key(explain)))
        return
    settings = read_checked(config)
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


def read_checked(path: Path) -> Config:
    """Return the configuration of a file. Raises ConfigError, also for problems that would appear only later."""
    from slipguard.config import raise_problems, read_config

    config = read_config(path)
    raise_problems(str(path), list(_find_problems(config)))
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
