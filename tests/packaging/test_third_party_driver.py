"""The README's example of a driver: installed as a package of its own, found by its name, held to the contract."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from sandbox import ROOT

EXAMPLE = Path(__file__).parent / "third_party"
STAND_IN = """
import threading
import cv2
import numpy as np

class NoiseCamera:
    '''Delivers noise at 60 fps in place of a camera that is not there.'''
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


@pytest.fixture(scope="module")
def installed(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment of a Python that has the example installed, and a camera."""
    place = tmp_path_factory.mktemp("third_party")
    pip = [sys.executable, "-m", "pip", "install", "--quiet", "--no-deps", "--no-index", "--no-build-isolation"]
    subprocess.run([*pip, "--target", str(place), str(EXAMPLE)], check=True)
    (place / "sitecustomize.py").write_text(STAND_IN)
    return {**os.environ, "PYTHONPATH": str(place)}


def test_it_passes_the_contract_suite(installed: dict[str, str]) -> None:
    suite = [sys.executable, "-m", "pytest", "-q", "tests/contract/test_sensor_contract.py", "-k", "driver"]
    options = ["--sensor-driver", "mini", "--sensor-settings", '{"serial": "M1"}']
    ran = subprocess.run([*suite, *options], cwd=ROOT, env=installed, capture_output=True, text=True, timeout=120)
    assert ran.returncode == 0, ran.stdout + ran.stderr
    passed = re.search(r"(\d+) passed", ran.stdout)
    assert passed is not None
    assert int(passed[1]) >= 5
    assert "skipped" not in ran.stdout


def test_a_configuration_may_name_it(installed: dict[str, str], tmp_path: Path) -> None:
    text = (ROOT / "config.toml").read_text()
    start, end = text.index("[left]"), text.index("[right]")
    config = tmp_path / "config.toml"
    config.write_text(text[:start] + '[left]\ndriver = "mini"\n[left.mini]\nserial = "M1"\n' + text[end:])
    slipguard = [sys.executable, "-m", "slipguard", "check", "--config", str(config)]
    ran = subprocess.run(slipguard, env=installed, capture_output=True, text=True, timeout=60)
    assert ran.returncode == 0, ran.stderr
    assert "mini" in ran.stdout


def test_the_readme_shows_this_very_driver() -> None:
    shown = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), re.S)
    drivers = [block for block in shown if "(TactileSensor)" in block]
    assert all(block == (EXAMPLE / "slipguard_mini.py").read_text() for block in drivers)
