"""`slipguard run` and `slipguard version`."""

from __future__ import annotations

import asyncio
import faulthandler
import sys
from functools import partial
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.check import read_checked
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
        settings, problem = read_or_last(lambda: read_checked(config), last_config_path())
    log.configure(json_lines=log_json)
    log.set_level(settings.log.level)
    if sim:
        from slipguard.sim_lifts.sim_daemon import run_simulated_cell

        daemon = run_simulated_cell(settings, bind_api, exit_if_stuck)
    else:
        reread = partial(read_checked, config)
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
        "numpy", "onnxruntime", "opencv-contrib-python-headless", "pydantic", "structlog", "ur-rtde", "torch",
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
