"""`slipguard install` below a temporary root: installed files, kept files, refusals."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from command_line import Ran, slipguard

from slipguard import installation
from slipguard.config import read_config
from slipguard.installation import CONFIG, PLACES, RULES, UNIT, InstallStep, StepAction

PROJECT = Path(__file__).parents[3]
UNIT_FILE, RULES_FILE, CONFIG_FILE = (PLACES[name] for name in (UNIT, RULES, CONFIG))


@pytest.fixture
def root(tmp_path: Path) -> Path:
    path = tmp_path / "root"
    path.mkdir()
    return path


@pytest.fixture
def install(root: Path, capfd: pytest.CaptureFixture[str]):  # type: ignore[no-untyped-def]
    """`slipguard install --root ROOT --prefix /opt/here WORDS...`"""

    def run(*words: object) -> Ran:
        return slipguard(capfd, "install", "--root", root, "--prefix", "/opt/here", *words)

    return run


def files(root: Path) -> dict[str, str]:
    return {str(path.relative_to(root)): path.read_text() for path in root.rglob("*") if path.is_file()}


def test_unit_rules_and_configuration_are_installed(root: Path, install) -> None:  # type: ignore[no-untyped-def]
    ran = install()
    assert (ran.code, ran.err) == (0, "")
    assert set(files(root)) == {str(path) for path in PLACES.values()}
    unit = (root / UNIT_FILE).read_text()
    assert "ExecStart=/opt/here/bin/slipguard run --config /etc/slipguard/config.toml\n" in unit
    assert "/opt/slipguard" not in unit
    assert (root / RULES_FILE).read_text() == (PROJECT / "systemd" / RULES).read_text()
    assert (root / CONFIG_FILE).read_text() == (PROJECT / "config.toml").read_text()
    assert all((root / path).stat().st_mode & 0o777 == 0o644 for path in PLACES.values())
    assert ran.out.count("skipped") == 5  # nothing is run for another root


def test_modem_manager_leaves_the_grippers_adapter_alone() -> None:
    """It would send modem commands on the line. It reads this property of the USB device, not of the port."""
    rules = (PROJECT / "systemd" / RULES).read_text().splitlines()
    (rule,) = (line.split(", ") for line in rules if "ID_MM_DEVICE_IGNORE" in line)
    assert {'SUBSYSTEM=="usb"', 'ENV{DEVTYPE}=="usb_device"', 'ATTR{idVendor}=="0403"'} < set(rule)
    assert rule[-1] == 'ENV{ID_MM_DEVICE_IGNORE}="1"'


def test_a_second_time_changes_nothing(root: Path, install) -> None:  # type: ignore[no-untyped-def]
    install()
    before = {path: path.stat().st_mtime_ns for path in root.rglob("*")}
    ran = install()
    assert ran.code == 0
    assert "written" not in ran.out
    assert {path: path.stat().st_mtime_ns for path in root.rglob("*")} == before


def test_a_dry_run_shows_all_steps_and_changes_nothing(root: Path, install) -> None:  # type: ignore[no-untyped-def]
    ran = install("--dry-run")
    assert ran.code == 0
    assert ran.out.count("would write") == 3
    assert list(root.iterdir()) == []


def test_a_dry_run_shows_replaced_files_as_a_diff(root: Path, install) -> None:  # type: ignore[no-untyped-def]
    install()
    unit = root / UNIT_FILE
    unit.write_text(unit.read_text().replace("WatchdogSec=3", "WatchdogSec=30"))
    ran = install("--dry-run")
    assert "-WatchdogSec=30" in ran.out
    assert "+WatchdogSec=3\n" in ran.out
    assert "WatchdogSec=30" in unit.read_text()
    assert "replaced" in install().out
    assert "WatchdogSec=3\n" in unit.read_text()


def test_an_existing_configuration_is_never_overwritten(  # type: ignore[no-untyped-def]
    root: Path, tmp_path: Path, install
) -> None:
    mine = tmp_path / "mine.toml"
    mine.write_text((PROJECT / "config.toml").read_text().replace("D20479", "D20001"))
    assert install("--config", mine).code == 0
    assert read_config(root / CONFIG_FILE).left.settings.serial == "D20001"  # type: ignore[attr-defined]
    assert f"kept  {root / CONFIG_FILE}: your own file" in install().out
    mine.write_text(mine.read_text().replace("D20001", "D20002"))
    ran = install("--config", mine)
    assert ran.code == 0
    assert f"kept  {root / CONFIG_FILE}: your own file differs from --config; move it away" in ran.out
    assert "D20001" in (root / CONFIG_FILE).read_text()


def test_a_wrong_configuration_is_not_installed(root: Path, tmp_path: Path, install) -> None:  # type: ignore[no-untyped-def]
    wrong = tmp_path / "wrong.toml"
    wrong.write_text((PROJECT / "config.toml").read_text().replace("force_max_n = 130", "force_max_n = 900"))
    ran = install("--config", wrong)
    assert ran.code == 2
    assert "force_max_n" in ran.complaint
    assert list(root.iterdir()) == []


def test_uninstall_keeps_the_configuration(root: Path, install) -> None:  # type: ignore[no-untyped-def]
    install()
    ran = install("--uninstall")
    assert ran.code == 0
    assert set(files(root)) == {str(CONFIG_FILE)}
    assert f"kept  {root / CONFIG_FILE}" in ran.out
    assert install("--uninstall").code == 0


def test_json_is_one_object(install) -> None:  # type: ignore[no-untyped-def]
    received = json.loads(install("--json", "--dry-run").out)
    assert received["dry_run"] is True
    assert [step["do"] for step in received["steps"]] == ["write"] * 3 + ["skip"] * 5


@pytest.mark.parametrize("prefix", ["/opt/my robots", "/opt/100%", '/opt/"x"'])
def test_a_path_that_systemd_would_misread_is_refused(
    root: Path, capfd: pytest.CaptureFixture[str], prefix: str
) -> None:
    ran = slipguard(capfd, "install", "--root", root, "--prefix", prefix)
    assert "needs an absolute path without spaces, quotes, % and $" in ran.complaint


def test_a_missing_root_is_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd, "install", "--root", tmp_path / "nowhere")
    assert "nowhere: no such folder" in ran.complaint


def test_root_is_needed_for_this_machine(monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr(installation, "carry_out", lambda step: pytest.fail(f"{step} was done"))
    assert "needs root: run `sudo " in slipguard(capfd, "install").complaint


def test_a_program_that_the_service_cannot_access_is_refused(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(installation, "carry_out", lambda step: pytest.fail(f"{step} was done"))
    ran = slipguard(capfd, "install", "--prefix", "/home/me/slipguard/.venv")
    assert "is in /home, which is hidden from the service; install slipguard where" in ran.complaint
    assert "not possible: " in slipguard(capfd, "install", "--prefix", "/home/me", "--dry-run").err


def test_a_folder_closed_to_other_users_is_inaccessible(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(installation, "HIDDEN", ())
    program = tmp_path / "bin" / "slipguard"
    program.parent.mkdir()
    assert "No such file" in (installation.out_of_reach(program) or "")
    program.touch()
    program.chmod(0o755)
    for folder in program.parents:
        if folder.is_relative_to(tmp_path.parents[1]):
            folder.chmod(0o755)
    program.parent.chmod(0o700)
    assert installation.out_of_reach(program) == f"{program.parent} is not accessible to other users"


def test_a_command_that_fails_is_one_line() -> None:
    with pytest.raises(Exception, match=r"`false` failed \(1\): no output"):
        installation.carry_out(InstallStep(StepAction.RUN, "false"))
    with pytest.raises(Exception, match="no-such-program`: not found; install systemd"):
        installation.carry_out(InstallStep(StepAction.RUN, "no-such-program"))


@pytest.mark.parametrize("path", [UNIT_FILE, RULES_FILE])
def test_a_masked_unit_or_rule_stays_masked(root: Path, install, path: Path) -> None:  # type: ignore[no-untyped-def]
    masked = root / path
    masked.parent.mkdir(parents=True)
    masked.symlink_to("/dev/null")
    for words in ((), ("--dry-run",)):
        ran = install(*words)
        assert ran.code == 1
        assert "/dev/null: it was switched off on purpose" in ran.err
    assert install("--uninstall").code == 0
    assert os.readlink(masked) == "/dev/null"
