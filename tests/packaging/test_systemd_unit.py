"""The unit file: what the service relies on, and what `systemd-analyze` reports where it is installed."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from slipguard.thread_priority import FIRST

UNIT = Path(__file__).parents[2] / "systemd" / "slipguard.service"
ANALYZE = shutil.which("systemd-analyze")


def settings() -> dict[str, list[str]]:
    found: dict[str, list[str]] = {}
    for line in UNIT.read_text().splitlines():
        key, equals, value = line.partition("=")
        if equals and not line.startswith("#"):
            found.setdefault(key, []).append(value)
    return found


def test_it_starts_the_daemon_and_watches_over_it() -> None:
    unit = settings()
    assert unit["ExecStart"] == ["/opt/slipguard/bin/slipguard run --config /etc/slipguard/config.toml"]
    assert unit["Type"] == ["notify"]
    assert float(unit["WatchdogSec"][0]) > 0
    assert unit["Restart"] == ["on-failure"]
    checked, reloaded = unit["ExecReload"]
    assert "slipguard check --config /etc/slipguard/config.toml" in checked
    assert "chrt --other 0" in checked, "the check must not compete with the control loop"
    assert reloaded == "/bin/kill -HUP $MAINPID"
    assert "network-online" not in "".join(unit["After"])  # the grip is not left alone for an arm that is late
    assert (unit["CPUSchedulingPolicy"], unit["CPUSchedulingPriority"]) == (["rr"], [f"{FIRST}"])
    assert "ORT_DISABLE_TELEMETRY=1" in unit["Environment"]


def test_it_may_use_cameras_and_serial_ports_and_no_other_device() -> None:
    unit = settings()
    assert unit["DevicePolicy"] == ["closed"]
    modules = "modprobe@uvcvideo.service modprobe@usbserial.service modprobe@cdc_acm.service"
    for key in ("Wants", "After"):
        assert modules in unit[key], "the node of a module that is loaded after the start is not in DeviceAllow"
    assert unit["DeviceAllow"] == ["char-video4linux rw", "char-ttyUSB rw", "char-ttyACM rw"]
    assert (unit["Group"], unit["SupplementaryGroups"]) == (["dialout"], ["video"])


@pytest.mark.extras("systemd-analyze")
def test_systemd_knows_every_key_and_finds_it_confined() -> None:
    assert ANALYZE is not None
    verified = subprocess.run([ANALYZE, "verify", str(UNIT)], capture_output=True, text=True, check=False)
    complaints = [line for line in verified.stderr.splitlines() if UNIT.name in line and "not executable" not in line]
    assert complaints == []
    confined = subprocess.run(
        [ANALYZE, "security", "--offline=yes", "--threshold=20", str(UNIT)], capture_output=True, text=True, check=False
    )
    assert confined.returncode == 0, confined.stdout[-500:]
