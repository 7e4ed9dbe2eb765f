"""Importing slipguard writes nothing, opens no connection and needs no vendor library."""

from __future__ import annotations

from sandbox import VENDOR, Sandbox

IMPORT_EVERYTHING = """
import importlib, pkgutil
import slipguard
torch_only = ("slipguard.training",)
for module in pkgutil.walk_packages(slipguard.__path__, "slipguard."):
    if not module.name.endswith("__main__") and not module.name.startswith(torch_only):
        importlib.import_module(module.name)
for name in ("digit.fake", "robotiq.fake", "ur5.fake", "digit.replay"):
    importlib.import_module("slipguard_drivers." + name)
"""


def test_importing_every_module_leaves_no_trace(sandbox: Sandbox) -> None:
    done = sandbox.run("-W", "error", "-c", IMPORT_EVERYTHING)
    assert done.returncode == 0, done.stderr
    assert done.stdout + done.stderr == ""
    assert sandbox.left_behind == []


def test_the_watch_itself_works(sandbox: Sandbox) -> None:
    """A connection, a look-up and a vendor library are noticed; a local socket is not."""
    connect = "import socket; socket.create_connection(('127.0.0.1', 9), 1)"
    assert sandbox.run("-c", connect).returncode == 99
    send = "import socket; socket.socket(type=socket.SOCK_DGRAM).sendto(b'x', ('127.0.0.1', 9))"
    assert sandbox.run("-c", send).returncode == 99
    for name in VENDOR:
        assert f"{name} is blocked" in sandbox.run("-c", f"import {name}").stderr
    local = "import socket; a, b = socket.socketpair(); a.send(b'x')"
    assert sandbox.run("-c", local).returncode == 0
