"""A place to run slipguard where nothing may go wrong: watched, and with nothing in it."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

ROOT = Path(__file__).parents[2]
VENDOR = ("rtde_control", "rtde_receive", "rtde_io", "dashboard_client", "pymodbus", "serial")

WATCHED = f"""
import os, socket, sys
sys.dont_write_bytecode = True
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in {VENDOR!r}:
            raise ImportError(f"{{name}} is blocked")
if "VENDOR_BLOCKED" in os.environ:
    sys.meta_path.insert(0, Refuse())
def watch(event, arguments):
    if event == "socket.getaddrinfo" or (event in ("socket.connect", "socket.sendto")
                                         and arguments[0].family != socket.AF_UNIX):
        sys.stderr.write(f"a connection was opened: {{event}} {{arguments}}\\n")
        sys.stderr.flush()
        os._exit(99)
sys.addaudithook(watch)
"""


@dataclass(frozen=True)
class Sandbox:
    """An empty home, working directory and folder for temporary files; opening a connection ends with exit code 99."""

    path: Path
    packages: Path | None = None

    def run(self, *words: str, vendor: bool = False) -> subprocess.CompletedProcess[str]:
        """`python WORDS...` with `packages` before all others; without `vendor` no vendor library can be imported."""
        search = [str(self.path / "watch"), *([str(self.packages)] if self.packages else [])]
        return subprocess.run(
            [sys.executable, *words],
            cwd=self.path / "work",
            env={
                "HOME": str(self.path / "home"),
                "TMPDIR": str(self.path / "tmp"),
                "PATH": "/usr/bin:/bin",
                "PYTHONPATH": os.pathsep.join(search),
                "OMP_NUM_THREADS": "1",
                **({} if vendor else {"VENDOR_BLOCKED": "1"}),
            },
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            check=False,
        )

    @property
    def left_behind(self) -> list[Path]:
        """Whatever is in the three folders now."""
        return [path for name in ("home", "work", "tmp") for path in (self.path / name).rglob("*")]


def sandbox_in(path: Path, packages: Path | None) -> Sandbox:
    """An empty sandbox."""
    for name in ("home", "work", "tmp", "watch"):
        (path / name).mkdir()
    (path / "watch" / "sitecustomize.py").write_text(WATCHED)
    return Sandbox(path, packages)
