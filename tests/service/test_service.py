"""The service as systemd runs it, from the wheel, against an emulated cell: one working day.

In this order: each test goes on where the one before it ended.
"""

from __future__ import annotations

import json
import re
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from cell_rig import PATIENT_GUARD
from container import PROGRAM, UNIT, Container, until

from slipguard.thread_priority import FIRST, SECOND
from slipguard_emulators.cell.cell_config import CellPaths, config_text

pytestmark = pytest.mark.service
CELL = CellPaths(Path("/srv/cell"))
OWN = ("var/lib/private/slipguard/", "var/log/journal/", "srv/cell/")
"""Where the service, the journal and the emulator may write; /run and /tmp are not on the disk."""
BY_SYSTEMD = ("var/lib/systemd/", "etc/systemd/system/multi-user.target.wants/", "var/cache/private", "var/log/wtmp")
GRASP_N = 30.0


@pytest.fixture(scope="module")
def config(container: Container) -> Path:
    """The emulated cell's configuration without its own socket and state folder; where it lies on this side."""
    text = config_text(
        CELL, gripper={"port": str(CELL.gripper)}, mode="lift", host="127.0.0.1", height_mm=60.0, speed_mm_s=60.0
    ).partition("[api]")[0]
    text = text.replace("[guard]\n", f"{PATIENT_GUARD}[guard]\n").replace('.sock"\n', '.sock"\nstall_ms = 1500\n')
    (container.tree / "srv" / "config.toml").write_text(text)
    return container.tree / "etc" / "slipguard" / "config.toml"


@pytest.fixture(scope="module")
def before(container: Container) -> dict[str, tuple[int, int]]:
    """Files as they were when all was installed and nothing ran yet."""
    return container.files()


@pytest.fixture(scope="module")
def cell(
    container: Container, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Callable[[], list[dict[str, Any]]]]:
    """The emulated cell, from its first use on; gives the truth so far."""
    said = tmp_path_factory.mktemp("emulator") / "said.txt"
    options = ("--folder", str(CELL.folder), "--fps", "30", "--object", "wrench", "--activated", "--robot-on")
    words = (PROGRAM, "emulate", "cell", "--json", *options)

    def truth() -> list[dict[str, Any]]:
        lines = (container.tree / "srv" / "cell" / "truth.jsonl").read_text().splitlines()
        return [json.loads(line) for line in lines if line.endswith("}")]

    with container.process(said, *words):
        until(lambda: '"ready"' in said.read_text(), "the cell is not ready", said.read_text)
        # Sockets and port are root's; the groups that own a real cell's are those the unit names.
        container.run("chgrp", "video", str(CELL.camera("left")), str(CELL.camera("right")), check=True)
        container.run("chmod", "660", str(CELL.camera("left")), str(CELL.camera("right")), check=True)
        container.run(
            "sh", "-c", f"chgrp dialout $(readlink -f {CELL.gripper}); chmod 660 $(readlink -f {CELL.gripper})"
        )
        yield truth


def ask(container: Container, *words: str) -> None:
    """`slipguard ctl WORDS...` until it is not refused: on a busy machine a device may just be late."""
    newest: list[subprocess.CompletedProcess[str]] = []

    def done() -> bool:
        newest.append(container.run(PROGRAM, "ctl", *words))
        return newest[-1].returncode == 0

    until(done, f"`slipguard ctl {' '.join(words)}` is refused", lambda: (newest[-1].stderr, container.state()))


def said(container: Container, words: str) -> bool:
    return any(words in entry["MESSAGE"] for entry in container.journal())


def held(state: dict[str, Any]) -> bool:
    return state["phase"] == "holding" and not state["waiting_for"] and state["target_force_n"] >= GRASP_N


def test_installing_twice_changes_nothing(container: Container, config: Path) -> None:
    first = container.run(PROGRAM, "install", "--config", "/srv/config.toml")
    assert first.returncode == 0, first.stderr
    assert f"ExecStart={PROGRAM} run" in (container.tree / "etc/systemd/system" / UNIT).read_text()
    second = container.run(PROGRAM, "install", "--config", "/srv/config.toml")
    assert second.stdout.count("unchanged") == 3
    assert config.stat().st_mode & 0o777 == 0o644


def test_the_service_starts_without_devices_and_names_them(
    container: Container, before: dict[str, tuple[int, int]]
) -> None:
    container.systemctl("start")
    state = container.wait_for(lambda state: len(state["waiting_for"]) == 4, "it does not wait")
    assert [line.split(":")[0] for line in state["waiting_for"]] == ["left", "right", "gripper", "arm"]
    assert container.shown("ActiveState") == "active"
    assert container.shown("NRestarts") == "0"
    status = container.run("systemctl", "status", "--no-pager", UNIT).stdout
    assert "active (running)" in status


def test_devices_that_appear_later_are_used(container: Container, cell: Callable[[], list[dict[str, Any]]]) -> None:
    container.wait_for(lambda state: not state["waiting_for"], "the devices are not taken up")
    shown = container.run(PROGRAM, "ctl", "state")
    assert shown.returncode == 0, shown.stderr
    for device in ("left", "right", "gripper", "arm"):  # troubled: there, and late at that moment
        assert re.search(rf"^{device} +(ready|troubled)\b", shown.stdout, re.M), shown.stdout


def test_the_service_grips_and_is_confined(
    container: Container, cell: Callable[[], list[dict[str, Any]]], capsys: pytest.CaptureFixture[str]
) -> None:
    ask(container, "calibrate")
    ask(container, "grasp", "--force-n", str(GRASP_N))
    container.wait_for(held, "nothing is held")
    rated = container.run("systemd-analyze", "security", "--no-pager", UNIT).stdout
    exposure = float(rated.partition("exposure level for slipguard.service: ")[2].split()[0])
    with capsys.disabled():
        print(f" exposure {exposure}", end="")
    assert exposure <= 2.0
    policies = container.run("ps", "-eLo", "cls=,rtprio=,pid=,lwp=,comm=,args=").stdout.splitlines()
    running = [line.split(None, 5) for line in policies if "slipguard" in line and "emulate" not in line]
    threads = [line for line in running if " run " in line[5]]
    assert {line[0] for line in threads} == {"RR"}
    assert {line[1] for line in threads if line[2] == line[3]} == {f"{FIRST}"}
    assert len([line for line in threads if line[1] == f"{SECOND}"]) >= 3, "both fingers and the recorder"
    assert {line[0] for line in running if "slipguard.web" in line[5]} == {"B"}
    owner, group, mode = container.run("stat", "--format=%U %G %a", "/run/slipguard/slipguard.sock").stdout.split()
    assert (owner != "root", group, mode) == (True, "dialout", "660")


def test_the_service_reloads_a_changed_configuration(container: Container, config: Path) -> None:
    config.write_text(config.read_text().replace("[guard]\n", "[guard]\nforce_max_n = 120\n"))
    container.systemctl("reload")
    until(lambda: said(container, "guard.force_max_n: 130.0 -> 120.0"), "not taken up", container.journal)
    config.write_text(config.read_text().replace('mode = "lift"', 'mode = "guard"'))
    container.systemctl("reload")
    until(lambda: said(container, '"lift" -> "guard" needs a restart'), "not refused", container.journal)
    config.write_text(config.read_text().replace('mode = "guard"', 'mode = "lift"'))
    assert container.shown("ActiveState") == "active"
    container.wait_for(held, "it does not hold any more")


def test_a_bad_file_fails_the_reload_and_the_service_starts_with_its_last_configuration(
    container: Container, config: Path
) -> None:
    good = config.read_text()
    config.write_text(good.replace("force_max_n", "forse_max_n"))
    assert container.run("systemctl", "reload", UNIT).returncode != 0
    assert [entry["PRIORITY"] for entry in container.journal() if "forse_max_n" in entry["MESSAGE"]] == ["3"]
    container.run("kill", "-KILL", container.shown("MainPID"), check=True)
    until(lambda: container.shown("NRestarts") == "1", "not restarted", container.journal)
    state = container.wait_for(held, "it does not take the object over again")
    assert "forse_max_n: no such key" in state["config_problem"]
    assert state["limits"]["force_max_n"] == 120
    assert "forse_max_n" in container.run(PROGRAM, "ctl", "state").stdout
    config.write_text(good)
    container.systemctl("reload")
    container.wait_for(lambda state: state["config_problem"] is None, "the corrected file is not used")


@pytest.mark.parametrize("signal", ["STOP", "KILL"])
def test_a_hung_or_killed_service_is_restarted_and_the_grip_stays(
    container: Container, cell: Callable[[], list[dict[str, Any]]], signal: str
) -> None:
    force_n, main = cell()[-1]["force"], container.shown("MainPID")
    restarts = str(int(container.shown("NRestarts")) + 1)
    assert int(main) > 1
    container.run("kill", f"-{signal}", main, check=True)
    until(lambda: container.shown("NRestarts") == restarts, "not restarted", container.journal)
    container.wait_for(held, "it does not take the object over again")
    assert container.shown("MainPID") != main
    truth = cell()
    assert truth[-1]["in_contact"]
    assert truth[-1]["force"] >= force_n - 0.5
    if signal == "STOP":
        journal = container.run("journalctl", "--no-pager", "--unit", UNIT).stdout
        assert "Watchdog timeout" in journal
        assert "Fatal Python error: Aborted" in journal  # and where each thread was


def test_a_stopped_service_keeps_the_grip(container: Container, cell: Callable[[], list[dict[str, Any]]]) -> None:
    began = len(cell())
    container.systemctl("stop")
    assert container.shown("Result") == "success"
    container.run("sleep", "1")
    after = cell()[began:]
    assert after, "the truth goes on"
    assert all(line["in_contact"] and line["force"] >= GRASP_N - 0.5 and not line["dropped"] for line in after)
    assert said(container, "the grip stays as it is")


def test_the_doctor_checks_with_the_rights_of_the_service(
    container: Container, config: Path, cell: Callable[[], list[dict[str, Any]]]
) -> None:
    """Root could open all of them."""
    port = container.run("readlink", "-f", str(CELL.gripper)).stdout.strip()
    words = (PROGRAM, "doctor", "--config", "/etc/slipguard/config.toml", "--json")

    def found() -> dict[tuple[str, str], str]:
        checks = json.loads(container.run(*words).stdout)["checks"]
        assert not [one for one in checks if one["check"] == "rights"], checks
        return {(one["subject"], one["status"]): one["observed"] for one in checks}

    assert ("gripper", "problem") not in found()
    container.run("chgrp", "root", port, check=True)
    assert "access is denied" in found()["gripper", "problem"]
    container.run("chgrp", "dialout", port, check=True)


def test_the_service_writes_to_its_own_folders_only(container: Container, before: dict[str, tuple[int, int]]) -> None:
    after = container.files()
    assert any(path.startswith(OWN[0]) for path in after), "it has stored nothing"
    written = sorted(path for path, facts in after.items() if before.get(path) != facts)
    elsewhere = [path for path in written if not path.startswith((*OWN, *BY_SYSTEMD, "etc/slipguard/config.toml"))]
    assert elsewhere == []
