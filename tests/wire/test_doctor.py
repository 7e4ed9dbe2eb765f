"""The doctor on an emulated cell in the states that users bring about: each line says what to do next."""

from __future__ import annotations

import asyncio
import json
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
import structlog
from cell_rig import Cell, cell
from ur_scene import own_address

from slipguard.cli.app import run
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.doctor import gripper, sensor
from slipguard_drivers.ur5 import diagnostics as ur5_diagnostics

HOST = own_address(65)
UNPRIVILEGED_ID = 65534
TIMING = {"frame rate", "lost frames", "round trip", "RTDE rate"}


@dataclass(frozen=True)
class DoctorReport:
    """The doctor's report: exit code, and by subject and check the status, what was observed and what to do."""

    code: int
    lines: dict[tuple[str, str], tuple[str, str, str]]

    @property
    def problem(self) -> set[str]:
        """What is wrong with something, any the machine that runs the tests has time for."""
        return {key[0] for key, line in self.lines.items() if line[0] == "problem" and key[1] not in TIMING}

    def line(self, subject: str, check: str) -> str:
        """The line as people read it."""
        status, observed, action = self.lines[subject, check]
        return f"{status}: {observed} -> {action}"


@pytest.fixture(scope="module")
def there() -> Iterator[Cell]:
    """A cell in a folder that other users may enter, its no-contact images stored."""
    with tempfile.TemporaryDirectory(prefix="slipguard-test-") as name:
        folder = Path(name)
        folder.chmod(0o755)
        with cell(folder, HOST, "--object", "none", "--fps", 30, "--series", "e") as made:
            gel = BackgroundImage(np.full((320, 240, 3), 90, np.uint8), (2.0, 2.0, 2.0), 30)
            for serial in ("SIM-L", "SIM-R"):
                StateDir(made.folder / "state").save_background(serial, gel)
            patient = made.config.read_text().replace("[arm]\n", "timeout_ms = 1000\n[arm]\n", 1)
            made.config.write_text(patient + "\n[guard.tuning]\ngripper_timeout_s = 2.0\n")
            yield made


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Short looks."""
    monkeypatch.setattr(sensor, "OBSERVE_S", 0.5)
    monkeypatch.setattr(sensor, "FIRST_FRAME_S", 8.0)
    monkeypatch.setattr(sensor, "SETTLE_S", 0.2)
    monkeypatch.setattr(gripper, "READS", 20)
    monkeypatch.setattr(ur5_diagnostics, "MEASURE_S", 0.3)
    yield
    structlog.reset_defaults()


def ask(capfd: pytest.CaptureFixture[str], config: Path) -> DoctorReport:
    """Run `slipguard doctor --json`."""
    capfd.readouterr()
    code = run(["doctor", "--config", str(config), "--json"])
    said = capfd.readouterr()
    return parse_report(code, said.out, said.err)


def parse_report(code: int, out: str, err: str) -> DoctorReport:
    """Check what every report of the doctor has in common; stdout holds nothing but JSON."""
    assert "Traceback" not in out + err
    assert out.startswith("{"), f"exit code {code}, no JSON but {out!r}; on stderr: {err!r}"
    answer = json.loads(out)
    lines = {
        (one["subject"], one["check"]): (one["status"], one["observed"], one["action"]) for one in answer["checks"]
    }
    for status, observed, action in lines.values():
        assert observed
        assert "\n" not in observed + action
        assert action or status != "problem", f"nothing to do about: {observed}"
    assert answer["problems"] == [status for status, _, _ in lines.values()].count("problem")
    assert code == (1 if answer["problems"] else 0)
    return DoctorReport(code, lines)


def with_change(there: Cell, old: str, new: str) -> Path:
    """The cell's configuration with something else in one place."""
    text = there.config.read_text()
    assert old in text
    changed = there.folder / "changed.toml"
    changed.write_text(text.replace(old, new))
    return changed


@contextmanager
def failing(there: Cell, fault: str) -> Iterator[None]:
    there.order(f"fault {fault}")
    try:
        yield
    finally:
        there.order("clear")


AS_NOBODY = f"""
import contextlib, io, os, sys
from slipguard.cli.app import run
words = sys.argv[1:]
with contextlib.redirect_stdout(io.StringIO()):
    run(words)  # what it imports, it imports as root
os.setgroups([])
os.setresgid({UNPRIVILEGED_ID}, {UNPRIVILEGED_ID}, {UNPRIVILEGED_ID})
os.setresuid({UNPRIVILEGED_ID}, {UNPRIVILEGED_ID}, {UNPRIVILEGED_ID})
sys.exit(run(words))
"""
"""Root may do everything, so the doctor runs as a user without rights, in a process of its own."""


def test_all_present(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    report = ask(capfd, there.config)
    assert report.problem == set()
    assert report.line("left", "sensor") == "ok: found, serial SIM-L -> "
    assert "fps (30 configured)" in report.line("right", "frame rate")
    assert "of" in report.line("right", "lost frames")
    assert report.line("left", "background image").startswith("ok: 0 min old")
    assert "p50" in report.line("gripper", "round trip")
    assert "p99" in report.line("gripper", "round trip")
    assert "FTDI" in report.line("gripper", "adapter")
    assert report.line("gripper", "condition") == "ok: activated, at rest, 85 mm open -> "
    assert "125 requested" in report.line("arm", "RTDE rate")
    assert report.line("arm", "stops") == "ok: none active -> "
    assert report.line("arm", "mounting") == "ok: upright: up is 0° from the z axis of the base -> "
    assert report.line("arm", "TCP") == "ok: its z axis is 0° from that of the flange -> "
    assert report.line("arm", "payload") == "ok: 1.20 kg -> "
    assert "none runs" in report.line("daemon", "daemon")
    assert not there.events("released")
    assert not there.events("started"), "no script may have been sent to the robot"
    for part in ("gripper", "arm"):
        there.order(f"{part} log 1000")
    for moved in ("write", "drive", "command", "script"):
        assert f'"event\\": \\"{moved}' not in there.process.said, "the doctor only asks"
    assert '\\"dashboard\\"' in there.process.said, "the log is what was searched"


def test_people_see_a_table_that_fits(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    run(["doctor", "--config", str(there.config)])
    said = capfd.readouterr()
    assert said.err == ""
    assert all(len(line) <= 80 for line in said.out.splitlines()[:-1])
    assert ("no problems" in said.out) == ("✗" not in said.out)
    assert said.out.count("✓") > 15


def test_none_present(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    report = ask(capfd, with_change(there, str(there.folder), str(there.folder / "nowhere")))
    assert report.problem == {"left", "right", "gripper"}
    assert "start the program that serves the frames" in report.line("left", "sensor")
    assert "no such device -> plug the adapter in" in report.line("gripper", "port")


def test_none_present_of_the_usual_kind(capfd: pytest.CaptureFixture[str]) -> None:
    config = Path(__file__).parents[2] / "config.toml"
    report = ask(capfd, config)
    assert {"left", "right", "gripper", "arm"} <= report.problem
    assert report.line("left", "USB").endswith("-> check the USB cable")
    assert "ls /dev/serial/by-id" in report.line("gripper", "port")


def test_one_sensor_unplugged(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    with failing(there, "left.disconnect"):
        report = ask(capfd, there.config)
    assert report.problem == {"left"}
    assert "no such socket" in report.line("left", "sensor")
    with failing(there, "gripper.unplug"):
        report = ask(capfd, there.config)
    assert report.problem == {"gripper"}
    assert "plug" in report.line("gripper", "port")


@pytest.mark.extras("root")
def test_no_permission(there: Cell) -> None:
    command = [sys.executable, "-c", AS_NOBODY, "doctor", "--config", str(there.config), "--json"]
    ran = subprocess.run(command, cwd="/", capture_output=True, text=True, timeout=60.0, check=False)
    report = parse_report(ran.returncode, ran.stdout, ran.stderr)
    assert {"left", "right", "gripper"} <= report.problem
    assert "arm" not in report.problem
    assert "access is denied" in report.line("left", "sensor")
    assert "access is denied" in report.line("gripper", "port")
    assert "group" in report.line("gripper", "port")
    assert report.line("machine", "state folder").startswith("problem")


@pytest.mark.parametrize(
    ("name", "observed"),
    [("/dev/null", "not a serial port"), ("/etc/hostname", "not a serial port"), ("/dev/ttyNONE", "no such device")],
)
def test_wrong_port(there: Cell, capfd: pytest.CaptureFixture[str], name: str, observed: str) -> None:
    report = ask(capfd, with_change(there, str(there.folder / "ttyGripper"), name))
    assert report.problem == {"gripper"}
    about = [line[1] for (subject, _), line in report.lines.items() if subject == "gripper"]
    assert any(observed in line for line in about), about


def test_wrong_address(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    report = ask(capfd, with_change(there, f'"{HOST}"', f'"{own_address(66)}"'))
    assert report.problem == {"arm"}
    assert "address" in report.line("arm", "controller")


def test_gripper_without_power(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    with failing(there, "gripper.deaf"):
        report = ask(capfd, there.config)
    assert report.problem == {"gripper"}
    assert "check the gripper's power and the cable" in report.line("gripper", "gripper")


@pytest.mark.parametrize(
    "faults",
    [
        {
            ("left.stall", "frames"): "no frame within",
            ("right.corrupt", "frames"): "damaged",
            ("arm.protective_stop", "stops"): "protective",
        },
        {("left.frozen", "frames"): "same image", ("arm.emergency_stop", "stops"): "emergency"},
        {("arm.local", "control"): "local: the robot refuses scripts"},
        {("arm.freeze", "controller"): "sends no RTDE data"},
        {("arm.silence", "controller"): "does not answer"},
    ],
    ids=lambda faults: " ".join(name for name, _ in faults),
)
def test_further_problems_are_reported(
    there: Cell, capfd: pytest.CaptureFixture[str], faults: dict[tuple[str, str], str]
) -> None:
    with ExitStack() as failures:
        for name, _ in faults:
            failures.enter_context(failing(there, name))
        report = ask(capfd, there.config)
    subjects = {name.split(".")[0] for name, _ in faults}
    assert report.problem == subjects, {key: line for key, line in report.lines.items() if line[0] == "problem"}
    for (name, check), observed in faults.items():
        assert observed in report.line(name.split(".")[0], check)


@pytest.mark.campaign
def test_a_urcap_is_noted(there: Cell, capfd: pytest.CaptureFixture[str]) -> None:
    ready, done = threading.Event(), threading.Event()

    async def urcap() -> None:
        server = await asyncio.start_server(lambda reader, writer: writer.close(), HOST, 63352)
        ready.set()
        await asyncio.to_thread(done.wait)
        server.close()

    thread = threading.Thread(target=lambda: asyncio.run(urcap()))
    thread.start()
    try:
        assert ready.wait(10.0)
        report = ask(capfd, there.config)
    finally:
        done.set()
        thread.join()
    assert report.problem == set()
    assert report.line("arm", "URCap").startswith("note: Robotiq's gripper URCap runs on the controller (port 63352)")
