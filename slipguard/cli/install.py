"""`slipguard install`: install the systemd unit, the udev rules and a configuration."""

from __future__ import annotations

import os
import sys
import sysconfig
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from slipguard.cli.options import JsonOption

if TYPE_CHECKING:
    from slipguard.installation import InstallStep

DONE_WORDS = {
    "write": "written",
    "replace": "replaced",
    "remove": "removed",
    "run": "done",
    "same": "unchanged",
    "keep": "kept",
    "skip": "skipped",
}
DRY_RUN_WORDS = DONE_WORDS | {
    "write": "would write",
    "replace": "would replace",
    "remove": "would remove",
    "run": "would run",
}
ROOT = Path("/")


def install(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show each step and its changes; do nothing.")] = False,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Configuration to install; never overwrites a different one.")
    ] = None,
    prefix: Annotated[
        Path | None, typer.Option(help="The service runs `bin/slipguard` of this prefix. Default: this installation.")
    ] = None,
    root: Annotated[Path, typer.Option(help="Install below this folder, such as a disk image; runs nothing.")] = ROOT,
    uninstall: Annotated[bool, typer.Option("--uninstall", help="Remove unit and rules.")] = False,
    json: JsonOption = False,
) -> None:
    """Install the systemd unit, the udev rules and a configuration. Safe to repeat.

    An existing configuration is kept. The service is not started: use `systemctl enable --now slipguard`.

    Example: `slipguard install --config config.toml --dry-run`
    """
    import json as jsonlib

    from slipguard import installation
    from slipguard.errors import InputError, SlipguardError

    if not root.is_dir():
        raise InputError(f"{root}: no such folder; --root needs an existing folder")
    executable = _executable(prefix)
    running = installation.running_services(root)
    if uninstall:
        steps = list(installation.to_remove(root, running))
    else:
        steps = list(installation.to_install(root, executable, _read_checked(config), running))
    if not dry_run and root.resolve() == ROOT and os.geteuid() != 0:
        raise SlipguardError(f"needs root: run `sudo {executable} install`; --dry-run shows the steps without root")
    obstacle = None if uninstall or root.resolve() != ROOT else _find_obstacle(executable, this_one=prefix is None)
    if obstacle is not None and not dry_run:
        raise SlipguardError(obstacle)
    for step in steps:
        if not dry_run:
            installation.carry_out(step)
        if not json:
            _print_step(step, dry_run)
    if json:
        described = [{"do": one.do.value, "what": one.what, "why": one.why, "diff": one.diff} for one in steps]
        print(jsonlib.dumps({"dry_run": dry_run, "steps": described, "would_be_refused": obstacle}))
    if obstacle is not None:
        raise SlipguardError(f"not possible: {obstacle}")
    if not json and not uninstall and not dry_run:
        print("check the cell: slipguard doctor; then start the service: systemctl enable --now slipguard")
        print("if it is already running: systemctl restart slipguard, preferably with nothing held; the grip is kept")


def _executable(prefix: Path | None) -> Path:
    scripts = Path(sysconfig.get_path("scripts")) if prefix is None else prefix.absolute() / "bin"
    return scripts / "slipguard"


def _read_checked(config: Path | None) -> str | None:
    """Return the text of a configuration. Raises ConfigError if it is invalid."""
    if config is None:
        return None
    from slipguard.config import read_config

    read_config(config)
    return config.read_text(encoding="utf-8")


def _find_obstacle(executable: Path, *, this_one: bool) -> str | None:
    """Return why the service could not start after the installation; None if it could."""
    from slipguard.installation import missing_groups, out_of_reach

    for path in (executable, *([Path(sys.executable)] if this_one else [])):
        why = out_of_reach(path)
        if why is not None:
            return f"{why}; install slipguard where every user may run it: `python3 -m venv /opt/slipguard`"
    missing = missing_groups()
    if missing:
        return f"the groups {' and '.join(missing)}, which the unit needs, do not exist; create them with `groupadd`"
    return None


def _print_step(step: InstallStep, dry_run: bool) -> None:
    word = (DRY_RUN_WORDS if dry_run else DONE_WORDS)[step.do]
    print(f"{word:>16}  {step.what}" + (f": {step.why}" if step.why else ""))
    if dry_run and step.diff:
        print("\n".join(f"{'':18}{line}" for line in step.diff.splitlines()))
