"""The wheel, built once and installed into a folder of its own."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from sandbox import ROOT, Sandbox, sandbox_in


@pytest.fixture(scope="session")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The wheel of this checkout."""
    folder = tmp_path_factory.mktemp("wheel")
    build = "import sys; from hatchling.build import build_wheel; build_wheel(sys.argv[1])"
    done = subprocess.run(
        [sys.executable, "-c", build, str(folder)], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    (path,) = folder.glob("*.whl")
    return path


@pytest.fixture(scope="session")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with the wheel's content and nothing else."""
    folder = tmp_path_factory.mktemp("installed")
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-index", "--no-compile", "--quiet"]
    done = subprocess.run(
        [*pip, "--target", str(folder), str(wheel)], capture_output=True, text=True, check=False, cwd=folder
    )
    assert done.returncode == 0, done.stderr
    return folder


@pytest.fixture
def sandbox(tmp_path: Path) -> Sandbox:
    """For the package as the tests find it."""
    return sandbox_in(tmp_path, None)


@pytest.fixture
def installed_sandbox(tmp_path: Path, installed: Path) -> Sandbox:
    """For the package as the wheel brings it."""
    return sandbox_in(tmp_path, installed)
