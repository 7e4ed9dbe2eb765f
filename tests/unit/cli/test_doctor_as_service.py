"""The doctor runs with the rights of the installed unit: the command, and the results it returns."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path

import pytest

from slipguard.diagnosis import CheckStatus
from slipguard.doctor import as_service
from slipguard.errors import SlipguardError

UNIT = (Path(__file__).parents[3] / "systemd" / "slipguard.service").read_text()
CHECK = {"subject": "gripper", "status": "problem", "check": "port", "observed": "refused", "action": "check it"}


@pytest.fixture
def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    unit = tmp_path / "etc/systemd/system/slipguard.service"
    unit.parent.mkdir(parents=True)
    unit.write_text(UNIT)
    monkeypatch.setattr(as_service, "ROOT", tmp_path)
    return tmp_path


def test_the_command_has_the_units_rights_and_none_of_its_duties() -> None:
    words = as_service.command(UNIT, Path("/tmp/out.json"))
    properties = [word.removeprefix("--property=") for word in words if word.startswith("--property=")]
    for right in ("DynamicUser=yes", "Group=dialout", "SupplementaryGroups=video", "DevicePolicy=closed"):
        assert right in properties
    assert [one for one in properties if one.startswith("DeviceAllow=")] == [
        *("DeviceAllow=char-video4linux rw", "DeviceAllow=char-ttyUSB rw", "DeviceAllow=char-ttyACM rw")
    ]
    assert any("modprobe@usbserial.service" in one for one in properties if one.startswith("Wants="))
    duties = ("ExecStart", "ExecReload", "Restart", "WatchdogSec", "CPUScheduling", "NotifyAccess", "RuntimeDirectory")
    assert not [one for one in properties if one.startswith(duties)]
    assert [one for one in properties if one.startswith("Type=")] == ["Type=oneshot"]
    assert words[-1] == "/opt/slipguard/bin/slipguard"


def test_its_results_are_returned(installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(words: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        (output,) = [word.partition("file:")[2] for word in words if "StandardOutput=file:" in word]
        assert words[-4:] == ["doctor", "--config", "/etc/slipguard/config.toml", "--json"]
        Path(output).write_text(json.dumps({"problems": 1, "checks": [CHECK]}))
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(subprocess, "run", run)
    (found,) = as_service.run_checks_as_service(Path("/etc/slipguard/config.toml"))
    assert (found.subject, found.result.status, found.result.observed) == ("gripper", CheckStatus.PROBLEM, "refused")


@pytest.mark.parametrize("there", [True, False])
def test_a_failed_start_of_the_unit_is_an_error(there: bool, installed: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def run(words: list[str], **options: object) -> subprocess.CompletedProcess[str]:
        if not there:
            raise FileNotFoundError(2, "No such file", "systemd-run")
        return subprocess.CompletedProcess(words, 1, "", "Failed to start transient unit")

    monkeypatch.setattr(subprocess, "run", run)
    with pytest.raises(SlipguardError, match="systemd-run"):
        as_service.run_checks_as_service(Path("/etc/slipguard/config.toml"))


def test_only_root_with_the_services_configuration_is_checked_as_the_service(
    installed: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(as_service.os.path, "isdir", lambda path: True)
    own = installed / "etc/slipguard/config.toml"
    for user, config, possible in ((0, own, True), (1000, own, False), (0, installed / "other.toml", False)):
        monkeypatch.setattr(as_service.os, "geteuid", lambda user=user: user)
        assert as_service.is_possible(config) is possible
    monkeypatch.setattr(as_service.os, "geteuid", lambda: 0)
    (installed / "etc/systemd/system/slipguard.service").unlink()
    assert not as_service.is_possible(own)
