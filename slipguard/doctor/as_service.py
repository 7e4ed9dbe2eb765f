"""Run the checks with the rights of the service: its user, groups, devices and confinement, in a unit of its own.

Root may open every device, so a check as root misses what the service may not do.
"""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from collections.abc import Iterator
from pathlib import Path

from slipguard.diagnosis import CheckResult, CheckStatus, note
from slipguard.doctor.run_checks import SubjectCheck
from slipguard.errors import SlipguardError
from slipguard.installation import CONFIG, PLACES, UNIT

ROOT = Path("/")
LIMIT_S = 180.0
NOT_COPIED = (
    *("Type=", "NotifyAccess=", "Exec", "CPUScheduling", "Watchdog", "Timeout", "Restart", "Kill", "RuntimeDirectory="),
    *("Description=", "StartLimit", "WantedBy="),
)
"""Lines of the unit that make it a daemon; all others give or take rights."""


def is_possible(config: Path) -> bool:
    """Return whether root asks for the checks of the installed service's configuration under systemd."""
    return (
        os.geteuid() == 0
        and os.path.isdir("/run/systemd/system")
        and (ROOT / PLACES[UNIT]).is_file()
        and config.resolve() == ROOT / PLACES[CONFIG]
    )


def run_checks_as_service(config: Path) -> list[SubjectCheck]:
    """Return the results of `slipguard doctor` with the service's rights. Raises SlipguardError with the reason."""
    unit = (ROOT / PLACES[UNIT]).read_text(encoding="utf-8")
    with tempfile.TemporaryDirectory(prefix="slipguard-doctor-") as name:
        output = Path(name) / "output.json"
        words = [*command(unit, output), "doctor", "--config", str(config), "--json"]
        try:
            done = subprocess.run(words, capture_output=True, text=True, timeout=LIMIT_S, check=False)
        except (OSError, subprocess.TimeoutExpired) as error:
            raise SlipguardError(str(error)) from None
        try:
            checks = json.loads(output.read_bytes())["checks"]
        except (OSError, ValueError):
            raise SlipguardError(f"systemd-run: {' '.join(done.stderr.split()) or 'no result'}") from None
    return [
        SubjectCheck(
            one["subject"], CheckResult(one["check"], CheckStatus(one["status"]), one["observed"], one["action"])
        )
        for one in checks
    ]


def command(unit: str, output: Path) -> list[str]:
    """Return the command that runs the unit's program with the unit's rights, with stdout in a file."""
    own = ("Type=oneshot", "User=slipguard", "SuccessExitStatus=1", f"StandardOutput=file:{output}")
    properties = [f"--property={line}" for line in (*own, *rights(unit))]
    return ["systemd-run", "--quiet", "--collect", "--unit=slipguard-doctor", *properties, "--", program(unit)]


def rights(unit: str) -> Iterator[str]:
    """Yield the lines of a unit that give or take rights, and its dependencies."""
    for line in unit.splitlines():
        if "=" in line and not line.startswith(("#", *NOT_COPIED)):
            yield line


def program(unit: str) -> str:
    """Return the program that the unit starts."""
    start = next(line for line in unit.splitlines() if line.startswith("ExecStart="))
    return start.removeprefix("ExecStart=").split()[0]


def not_as_service(reason: str) -> SubjectCheck:
    """Return the note that the checks ran as root."""
    action = "run `systemctl start slipguard`, then the doctor again: it then reports what the service sees"
    return SubjectCheck("machine", note("rights", f"checked as root, not with the service's rights: {reason}", action))
