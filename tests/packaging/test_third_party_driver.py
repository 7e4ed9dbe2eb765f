"""The example drivers of drivers/README.md: installed as their own package, found by name, held to the contract."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from sandbox import ROOT

EXAMPLE = Path(__file__).parent / "third_party"
DEVICES = Path(__file__).parent / "example_devices.py"
STAND_IN = """
import threading
import cv2
import numpy as np

class NoiseCamera:
    '''Delivers noise at 60 fps in place of a camera.'''
    def __init__(self, index):
        self._random, self._pause = np.random.default_rng(index), threading.Event()
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


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """Environment variables of a Python that has the example package installed, and a camera."""
    folder = tmp_path_factory.mktemp("third_party")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(folder), str(EXAMPLE)], check=True)
    (folder / "sitecustomize.py").write_text(STAND_IN)
    return {**os.environ, "PYTHONPATH": str(folder)}


@contextmanager
def devices(object_mm: float) -> Iterator[dict[str, int]]:
    """Run the simulated gripper and arm; yields their TCP ports."""
    command = [sys.executable, str(DEVICES), str(object_mm)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            yield json.loads(process.stdout.readline())
        finally:
            process.kill()


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


def test_a_configuration_may_name_them(environment: dict[str, str], tmp_path: Path) -> None:
    config = tmp_path / "config.toml"
    config.write_text("""
[left]
driver = "opencv_camera"
[left.opencv_camera]
serial = "M1"
[right]
driver = "opencv_camera"
[right.opencv_camera]
serial = "M2"
index = 1
[gripper]
driver = "text_gripper"
[gripper.text_gripper]
host = "192.0.2.1"
[arm]
driver = "text_arm"
[arm.text_arm]
host = "192.0.2.2"
""")
    slipguard = [sys.executable, "-m", "slipguard", "check", "--config", str(config)]
    ran = subprocess.run(slipguard, env=environment, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stderr
    for name in ("opencv_camera", "text_gripper", "text_arm"):
        assert name in ran.stdout


def blocks_of_readme() -> list[str]:
    """Return the code blocks of drivers/README.md."""
    return re.findall(r"```(?:python|toml)\n(.*?)```", (ROOT / "drivers" / "README.md").read_text(), re.S)


@pytest.mark.parametrize("path", [EXAMPLE / "pyproject.toml", *sorted(EXAMPLE.glob("example_drivers/[a-z]*.py"))])
def test_the_drivers_readme_shows_these_very_files(path: Path) -> None:
    assert path.read_text() in blocks_of_readme()


@pytest.mark.parametrize("name", ["GelCamera", "run_virtual"])
def test_the_simulation_examples_of_the_readme_run(name: str) -> None:
    (code,) = (block for block in blocks_of_readme() if f"{name}(" in block and "class " not in block)
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
