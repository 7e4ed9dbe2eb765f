"""The container of the service, started once for all tests here.

`python tests/service/build_root.py --install` builds it.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path += [str(Path(__file__).parent), str(Path(__file__).parents[1] / "wire")]

from build_root import root_folder
from container import PROGRAM, Container

VARIABLE = "SLIPGUARD_SERVICE"
PROJECT = Path(__file__).parents[2]
BUILD = "import sys; from hatchling.build import build_wheel; print(build_wheel(sys.argv[1]))"


@pytest.fixture(scope="module")
def container(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """Boot it with the wheel of this checkout in /opt/slipguard, and delete it at the end.

    SLIPGUARD_SERVICE names another root than the one that `build_root.py` has built.
    """
    root = Path(os.environ.get(VARIABLE) or root_folder())
    assert root.is_dir(), f"{root} is not there; build it with `python tests/service/build_root.py --install`"
    with tempfile.TemporaryDirectory(prefix="slipguard-service-", dir=os.environ.get("TMPDIR", "/var/tmp")) as work:
        container = Container(root, Path(work))
        try:
            _install_wheel(container)
            container.boot()
            yield container
        finally:
            container.stop()


def _install_wheel(container: Container) -> None:
    """As a user does, with pip; what it depends on is there already."""
    built = subprocess.run(
        [sys.executable, "-c", BUILD, str(container.tree / "srv")], cwd=PROJECT, capture_output=True, text=True
    )
    assert built.returncode == 0, built.stderr
    wheel = f"/srv/{built.stdout.split()[-1]}"
    pip = ["chroot", str(container.tree), str(Path(PROGRAM).with_name("pip")), "install", "--quiet"]
    done = subprocess.run([*pip, "--no-index", "--no-deps", wheel], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
