"""The example drivers of drivers/README.md: installed as their own package, found by name, held to the contract."""

from __future__ import annotations

import json
import os
import re
import shlex
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import Any

import pytest
from sandbox import ROOT

EXAMPLE = Path(__file__).parent / "third_party"
DEVICES = Path(__file__).parent / "example_devices.py"
CELL = Path(__file__).parent / "example_cell.py"
HOST = "127.0.0.1"
FIRST_FORCE_N = 40.0
STAND_IN = """
import threading
import cv2
import numpy as np

class NoiseCamera:
    '''Delivers noise at 60 fps in place of a camera.'''
    def __init__(self, source):
        self._random, self._pause = np.random.default_rng(source), threading.Event()
    def isOpened(self):
        return True
    def read(self):
        self._pause.wait(1 / 60)
        return True, self._random.integers(0, 256, (480, 640, 3), np.uint8)
    def release(self):
        self._pause.set()

cv2.VideoCapture = NoiseCamera
"""
SENSOR_TABLE = {"serial": "M1"}
LINES_MAX = 79
PATIENT = "[guard.tuning]\nframes_timeout_s = 2\ngripper_timeout_s = 2\ncycle_timeout_s = 2\n"
"""For a busy machine."""


@pytest.fixture(scope="module")
def package(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder into which the example package is installed."""
    folder = tmp_path_factory.mktemp("third_party")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(folder), str(EXAMPLE)], check=True)
    return folder


@pytest.fixture(scope="module")
def environment(package: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables of a Python that has the example package installed, and a camera."""
    camera = tmp_path_factory.mktemp("camera")
    (camera / "sitecustomize.py").write_text(STAND_IN)
    return {**os.environ, "PYTHONPATH": f"{package}{os.pathsep}{camera}"}


@contextmanager
def started(*command: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """Run a Python program as long as the block."""
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, **options}
    with subprocess.Popen([sys.executable, *command], text=True, **pipes) as process:
        try:
            yield process
        finally:
            process.terminate()


@contextmanager
def devices(object_mm: float) -> Iterator[dict[str, int]]:
    """Run the simulated gripper and arm; yields their TCP ports."""
    with started(str(DEVICES), str(object_mm)) as process:
        yield json.loads(process.stdout.readline())


def run_contract(environment: dict[str, str], device: str, driver: str, table: dict[str, object], *more: str) -> int:
    """Run a contract suite on a driver of the package; returns how many tests passed, all others count as failures."""
    suite = [sys.executable, "-m", "pytest", "-q", f"tests/contract/test_{device}_contract.py", "-k", "driver"]
    options = [f"--{device}-driver", driver, f"--{device}-settings", json.dumps(table), *more]
    ran = subprocess.run([*suite, *options], cwd=ROOT, env=environment, capture_output=True, text=True, timeout=180)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    passed = re.search(r"(\d+) passed", ran.stdout)
    assert passed is not None
    assert "skipped" not in ran.stdout
    return int(passed[1])


@pytest.mark.campaign
def test_the_sensor_passes_the_contract_suite(environment: dict[str, str]) -> None:
    assert run_contract(environment, "sensor", "opencv_camera", dict(SENSOR_TABLE)) >= 5


@pytest.mark.campaign
@pytest.mark.parametrize(("object_mm", "options", "least"), [(41.2, ["--gripper-object"], 20), (0.0, [], 6)])
def test_the_gripper_passes_the_contract_suite(
    environment: dict[str, str], object_mm: float, options: list[str], least: int
) -> None:
    with devices(object_mm) as ports:
        table = {"host": "127.0.0.1", "port": ports["gripper"], "timeout_ms": 1000}
        assert run_contract(environment, "gripper", "text_gripper", table, *options) >= least


@pytest.mark.campaign
def test_the_arm_passes_the_contract_suite(environment: dict[str, str]) -> None:
    with devices(0.0) as ports:
        table = {"host": "127.0.0.1", "port": ports["arm"], "timeout_ms": 1000}
        assert run_contract(environment, "arm", "text_arm", table) >= 12


def configuration() -> str:
    """Return the configuration that drivers/README.md shows."""
    (text,) = (block for block in blocks_of_readme() if block.startswith("[left]"))
    return text


def test_a_configuration_may_name_them(environment: dict[str, str], tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text(configuration().replace('"none"', '"text_arm"') + '[arm.text_arm]\nhost = "192.0.2.2"\n')
    slipguard = [sys.executable, "-m", "slipguard", "check", "--config", str(config)]
    ran = subprocess.run(slipguard, env=environment, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stderr
    for name in ("opencv_camera", "text_gripper", "text_arm"):
        assert name in ran.stdout


def wait_for(reached: Callable[[dict[str, Any]], bool], run: Callable[..., str], within_s: float = 60.0) -> None:
    """Wait until the daemon's state is as it should be. A daemon that starts may respond late."""
    end_s = time.monotonic() + within_s
    while "error" in (state := json.loads(run("slipguard ctl state --json", None))) or not reached(state):
        assert time.monotonic() < end_s, state
        Event().wait(0.2)


@pytest.mark.campaign
@pytest.mark.realtime
def test_a_new_user_guards_a_grip(package: Path) -> None:
    """The commands of drivers/README.md in their order: two webcams, a gripper on TCP, no arm that slipguard knows."""
    with tempfile.TemporaryDirectory(prefix="sg") as name, started(str(CELL)) as cell:
        folder, home = Path(name), {**os.environ, "HOME": name, "PYTHONPATH": str(package)}
        ports = json.loads(cell.stdout.readline())
        text = configuration().replace('"192.0.2.1"', f'"{HOST}"').replace("5001", str(ports["gripper"]))
        for number, finger in enumerate(("left", "right")):
            text = text.replace(f"source = {number}", f'source = "http://{HOST}:{ports[finger]}"')
        (folder / "config.toml").write_text(text + PATIENT)

        def run(command: str, expected: int | None = 0) -> str:
            words = [sys.executable, "-m", *shlex.split(command, comments=True)]
            ran = subprocess.run(words, cwd=folder, env=home, capture_output=True, text=True, timeout=90, check=False)
            assert expected in (None, ran.returncode), ran.stdout + ran.stderr
            return ran.stdout

        (shown,) = (block for block in blocks_of_readme() if "slipguard ctl grasp" in block)
        check, doctor, daemon, calibrate, grasp, state, release = shown.splitlines()
        assert "the configuration is valid" in run(check)
        assert run(doctor, expected=1).count("none stored for") == 2
        with started("-m", *shlex.split(daemon, comments=True), cwd=folder, env=home, stderr=subprocess.DEVNULL):
            socket = folder / ".local/state/slipguard/slipguard.sock"
            end_s = time.monotonic() + 60.0
            while not socket.exists() and time.monotonic() < end_s:
                Event().wait(0.1)
            wait_for(lambda now: not now["waiting_for"], run)
            assert "background images of left and right stored" in run(calibrate)
            run(grasp)
            wait_for(lambda now: now["phase"] == "holding" and now["guarding"], run)
            assert "holding with 40 N per finger" in run(state)
            cell.stdin.write("lift 100\n")
            cell.stdin.flush()
            wait_for(lambda now: now["target_force_n"] > FIRST_FORCE_N, run)
            Event().wait(3.0)
            cell.stdin.write("truth\n")
            cell.stdin.flush()
            cell.stdout.readline()
            truth = json.loads(cell.stdout.readline())
            assert (truth["height_mm"], truth["dropped"]) == (100.0, None)
            assert abs(truth["rotation_deg"]) < 45.0
            run(f"{release.partition('#')[0]} --yes")
            wait_for(lambda now: now["phase"] == "idle", run)


def blocks_of_readme() -> list[str]:
    """Return the code blocks of drivers/README.md."""
    return re.findall(r"```(?:python|toml|sh)\n(.*?)```", (ROOT / "drivers" / "README.md").read_text(), re.S)


@pytest.mark.parametrize("name", ["gripper", "text_link"])
def test_the_drivers_readme_shows_this_very_driver(name: str) -> None:
    text = (EXAMPLE / "example_drivers" / f"{name}.py").read_text()
    assert text in blocks_of_readme()
    assert len(text.splitlines()) <= LINES_MAX


def test_the_entry_point_of_the_readme_is_the_packages() -> None:
    (shown,) = (block for block in blocks_of_readme() if block.startswith("[project.entry-points"))
    assert shown in (EXAMPLE / "pyproject.toml").read_text()
