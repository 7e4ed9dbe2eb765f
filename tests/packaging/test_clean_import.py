"""Importing slipguard writes nothing, opens no connection and needs neither vendor libraries nor optional packages."""

from __future__ import annotations

from sandbox import EXTRAS, VENDOR, Sandbox

IMPORT_EVERYTHING = """
import importlib, pkgutil
import slipguard
for module in pkgutil.walk_packages(slipguard.__path__, "slipguard."):
    if not module.name.endswith("__main__") and {chosen}:
        importlib.import_module(module.name)
for name in ("digit.fake", "robotiq.fake", "ur5.fake", "digit.replay"):
    importlib.import_module("slipguard_drivers." + name)
"""


def test_importing_all_but_training_leaves_no_trace(sandbox: Sandbox) -> None:
    chosen = "not module.name.startswith('slipguard.training.')"
    done = sandbox.run("-W", "error", "-c", IMPORT_EVERYTHING.format(chosen=chosen))
    assert done.returncode == 0, done.stderr
    assert done.stdout + done.stderr == ""
    assert sandbox.left_behind == []


def test_training_without_torch_is_one_line(sandbox: Sandbox) -> None:
    done = sandbox.run("-m", "slipguard", "train", "--out", "network.onnx")
    assert done.returncode == 2, done.stderr
    assert done.stderr.count("\n") == 1
    assert "torch" in done.stderr
    assert "pip install 'slipguard[train]'" in done.stderr
    assert sandbox.left_behind == []


def test_the_sandbox_notices_connections_and_blocked_packages(sandbox: Sandbox) -> None:
    connect = "import socket; socket.create_connection(('127.0.0.1', 9), 1)"
    assert sandbox.run("-c", connect).returncode == 99
    send = "import socket; socket.socket(type=socket.SOCK_DGRAM).sendto(b'x', ('127.0.0.1', 9))"
    assert sandbox.run("-c", send).returncode == 99
    tried = "\n".join(
        f"try:\n    import {name}\nexcept ImportError as error:\n    print(error)" for name in VENDOR + EXTRAS
    )
    assert sandbox.run("-c", tried).stdout.splitlines() == [f"No module named {name!r}" for name in VENDOR + EXTRAS]
    local = "import socket; a, b = socket.socketpair(); a.send(b'x')"
    assert sandbox.run("-c", local).returncode == 0
