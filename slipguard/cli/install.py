"""`slipguard install`: the service's unit, the udev rules and a configuration, put in place."""

from __future__ import annotations

import os
import sys
import sysconfig
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from slipguard.installation import Step

SAID = {
    "write": "written",
    "replace": "replaced",
    "remove": "removed",
    "run": "done",
    "same": "in place already",
    "keep": "kept",
    "skip": "left out",
}
WOULD = SAID | {"write": "would write", "replace": "would replace", "remove": "would remove", "run": "would run"}
HERE = Path("/")


def install(
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Show each step and what it changes; do nothing.")] = False,
    config: Annotated[
        Path | None, typer.Option("--config", "-c", help="Your configuration; it never overwrites another one.")
    ] = None,
    prefix: Annotated[
        Path | None, typer.Option(help="Whose `bin/slipguard` the service starts; default: this installation.")
    ] = None,
    root: Annotated[Path, typer.Option(help="Put all under this folder, such as a disk image's; runs nothing.")] = HERE,
    uninstall: Annotated[bool, typer.Option("--uninstall", help="Take unit and rules away again.")] = False,
    json: Annotated[bool, typer.Option("--json", help="One JSON object.")] = False,
) -> None:
    """Put the systemd unit, the udev rules and a configuration in place; safe to repeat.

    What you have configured stays. It starts nothing: `systemctl enable --now slipguard` does.
    Example: `slipguard install --config config.toml --dry-run`
    """
    import json as jsonlib

    from slipguard import installation
    from slipguard.errors import InputError, SlipguardError

    if not root.is_dir():
        raise InputError(f"{root}: no such folder; --root names one that is there")
    executable = _executable(prefix)
    live = installation.live(root)
    if uninstall:
        steps = list(installation.to_remove(root, live))
    else:
        steps = list(installation.to_install(root, executable, _text(config), live))
    if not dry_run and root.resolve() == HERE and os.geteuid() != 0:
        raise SlipguardError(f"root is needed: `sudo {executable} install`; --dry-run shows what it would do")
    why_not = None if uninstall or root.resolve() != HERE else _why_not(executable, this_one=prefix is None)
    if why_not is not None and not dry_run:
        raise SlipguardError(why_not)
    for step in steps:
        if not dry_run:
            installation.carry_out(step)
        if not json:
            _say(step, dry_run)
    if json:
        told = [{"do": one.do.value, "what": one.what, "why": one.why, "diff": one.diff} for one in steps]
        print(jsonlib.dumps({"dry_run": dry_run, "steps": told, "would_be_refused": why_not}))
    if why_not is not None:
        raise SlipguardError(f"it would be refused: {why_not}")
    if not json and not uninstall and not dry_run:
        print("`slipguard doctor` looks at the cell; then: systemctl enable --now slipguard")
        print("where it runs already: systemctl restart slipguard, best with nothing held; the grip stays")


def _executable(prefix: Path | None) -> Path:
    scripts = Path(sysconfig.get_path("scripts")) if prefix is None else prefix.absolute() / "bin"
    return scripts / "slipguard"


def _text(config: Path | None) -> str | None:
    """A configuration that has been checked. Raises ConfigError."""
    if config is None:
        return None
    from slipguard.config import read_config

    read_config(config)
    return config.read_text(encoding="utf-8")


def _why_not(executable: Path, *, this_one: bool) -> str | None:
    """Why the service could not start as it would be installed."""
    from slipguard.installation import missing_groups, out_of_reach

    for path in (executable, *([Path(sys.executable)] if this_one else [])):
        why = out_of_reach(path)
        if why is not None:
            return f"{why}; install slipguard where everybody may run it: `python3 -m venv /opt/slipguard`"
    missing = missing_groups()
    if missing:
        return f"the unit needs the groups {' and '.join(missing)}, which are not there; `groupadd` makes them"
    return None


def _say(step: Step, dry_run: bool) -> None:
    word = (WOULD if dry_run else SAID)[step.do]
    print(f"{word:>16}  {step.what}" + (f": {step.why}" if step.why else ""))
    if dry_run and step.diff:
        print("\n".join(f"{'':18}{line}" for line in step.diff.splitlines()))
