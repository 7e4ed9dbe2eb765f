"""An empty, watched place in which to run slipguard: no connections, no vendor libraries, no optional packages."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
VENDOR = ("rtde_control", "rtde_receive", "rtde_io", "dashboard_client", "pymodbus", "serial")
EXTRAS = ("torch", "onnx", "segmentation_models_pytorch", "mujoco", "distributed")

WATCHED = """
import importlib.machinery, os, socket, sys
sys.dont_write_bytecode = True
blocked = os.environ["BLOCKED"].split()
class Finder(importlib.machinery.PathFinder):
    @classmethod
    def find_spec(cls, name, path=None, target=None):
        return None if name.partition(".")[0] in blocked else super().find_spec(name, path, target)
sys.meta_path[:] = [Finder if one is importlib.machinery.PathFinder else one for one in sys.meta_path]
def watch(event, arguments):
    if event == "socket.getaddrinfo" or (event in ("socket.connect", "socket.sendto")
                                         and arguments[0].family != socket.AF_UNIX):
        sys.stderr.write(f"a connection was opened: {event} {arguments}\\n")
        sys.stderr.flush()
        os._exit(99)
sys.addaudithook(watch)
"""


@dataclass(frozen=True)
class Sandbox:
    """An empty home, working directory and folder for temporary files; opening a connection ends with exit code 99."""

    path: Path
    packages: Path | None = None

    def run(self, *words: str, vendor: bool = False, extras: bool = False) -> subprocess.CompletedProcess[str]:
        """Run `python WORDS...` with `packages` before all others.

        Args:
            words: Arguments of Python.
            vendor: Whether the vendor libraries can be imported.
            extras: Whether the optional packages can be imported.
        """
        blocked = (() if vendor else VENDOR) + (() if extras else EXTRAS)
        search = [str(self.path / "watch"), *([str(self.packages)] if self.packages else [])]
        return subprocess.run(
            [sys.executable, *words],
            cwd=self.path / "work",
            env={
                "HOME": str(self.path / "home"),
                "XDG_STATE_HOME": str(self.path / "s"),  # a Unix socket's path has at most 107 bytes
                "TMPDIR": str(self.path / "tmp"),
                "PATH": "/usr/bin:/bin",
                "PYTHONPATH": os.pathsep.join(search),
                "OMP_NUM_THREADS": "1",
                "BLOCKED": " ".join(blocked),
            },
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )

    @property
    def left_behind(self) -> list[Path]:
        """Everything in the three folders now."""
        return [path for name in ("home", "work", "tmp") for path in (self.path / name).rglob("*")]


def sandbox_in(path: Path, packages: Path | None) -> Sandbox:
    """An empty sandbox."""
    for name in ("home", "work", "tmp", "watch"):
        (path / name).mkdir()
    (path / "watch" / "sitecustomize.py").write_text(WATCHED)
    return Sandbox(path, packages)
