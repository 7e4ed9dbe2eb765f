"""Importing slipguard writes nothing, opens no connection and needs no vendor library."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

VENDOR = ("rtde_control", "rtde_receive", "rtde_io", "dashboard_client", "pymodbus", "serial")

IMPORT_EVERYTHING = """
import importlib, pkgutil, sys
class Refuse:
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in BLOCKED:
            raise ImportError(f"{name} is blocked")
sys.meta_path.insert(0, Refuse())
import socket
def no_network(*arguments, **options):
    raise AssertionError("a connection was opened")
socket.socket.connect = no_network
import slipguard
skipped = ("slipguard.lab.train", "slipguard.lab.networks")
for module in pkgutil.walk_packages(slipguard.__path__, "slipguard."):
    if not module.name.endswith("__main__") and not module.name.startswith(skipped):
        importlib.import_module(module.name)
for name in ("digit.fake", "robotiq.fake", "ur5.fake", "digit.replay"):
    importlib.import_module("slipguard_drivers." + name)
"""


def test_importing_every_module_leaves_no_trace(tmp_path: Path) -> None:
    script = f"BLOCKED = {VENDOR!r}\n{IMPORT_EVERYTHING}"
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script],
        env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin", "MPLCONFIGDIR": str(tmp_path / "mpl")},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    written = [path for path in tmp_path.rglob("*") if path.is_file() and "mpl" not in path.parts]
    assert written == []
