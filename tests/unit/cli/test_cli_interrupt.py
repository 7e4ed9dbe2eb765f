"""Ctrl-C at random times: one line, exit code 1, no traceback, no remaining process or socket."""

from __future__ import annotations

import os
import random
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from sampled import sampled

from slipguard.daemon.api.client import Client
from slipguard.errors import SlipguardError

SLOW_S = 60.0
"""Longer than anything here takes, on any machine."""
SAY_WHEN_READY = """
import signal, sys
set_handler = signal.signal
def and_say_so(number, handler):
    signal.signal = set_handler
    before = set_handler(number, handler)
    print("ready", flush=True)
    return before
signal.signal = and_say_so
from slipguard.cli import main
main()
"""
"""The start of the interpreter cannot be made to fall silent; from slipguard's first statement on, it is."""
pause = threading.Event().wait


def start(folder: Path, *words: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-c", SAY_WHEN_READY, *words],
        cwd=folder,
        env={"HOME": str(folder), "PATH": os.environ["PATH"], "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


def children(pid: int) -> list[int]:
    """Processes whose parent is `pid`, and theirs."""
    found = []
    for each in filter(str.isdecimal, os.listdir("/proc")):
        try:
            status = Path("/proc", each, "status").read_text()
            lines = dict(line.split(":\t", 1) for line in status.splitlines() if ":\t" in line)
        except OSError:
            continue
        if int(lines["PPid"]) == pid and not lines["State"].startswith("Z"):
            found += [int(lines["Pid"]), *children(int(lines["Pid"]))]
    return found


def gone(pids: list[int]) -> bool:
    """Return whether all processes have ended, now or soon."""
    deadline_s = time.monotonic() + SLOW_S
    while any(Path(f"/proc/{pid}").exists() for pid in pids):
        if time.monotonic() > deadline_s:
            return False
        pause(0.02)
    return True


@pytest.fixture(scope="module")
def cell(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A home with frames to measure."""
    home = tmp_path_factory.mktemp("cell")
    (home / "frames").mkdir()
    drawn = cv2.imencode(".png", np.random.default_rng(0).integers(60, 120, (320, 240, 3), np.uint8))[1].tobytes()
    for number in range(200):
        (home / "frames" / f"{number:03d}.png").write_bytes(drawn)
    return home


COMMANDS = {
    "a simulation": (["--sim", "--lifts", "2"], 4.0),
    "a fast simulation": (["--sim", "--lifts", "2", "--speed", "fast", "--json"], 3.0),
    "a daemon": (["run", "--sim"], 3.0),
    "a measurement": (["measure", "frames", "--independent", "--json"], 2.0),
}


@pytest.mark.parametrize("seed", sampled(range(2)))
@pytest.mark.parametrize("kind", COMMANDS)
def test_ctrl_c_at_any_moment(kind: str, seed: int, cell: Path) -> None:
    words, longest_s = COMMANDS[kind]
    process = start(cell, *words)
    assert process.stdout is not None
    assert process.stdout.readline() == "ready\n"
    pause(random.Random(f"{kind} {seed}").uniform(0.0, longest_s))
    drawing = children(process.pid)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=SLOW_S)
    assert "Traceback" not in err
    assert "Exception" not in err
    if process.returncode == 0:
        assert "slipguard stops" in err or kind == "a measurement"
    else:
        assert process.returncode == 1
        assert err.splitlines()[-1] == "slipguard: interrupted"
        assert err.count("interrupted") == 1
    assert gone(drawing)
    assert not list(cell.rglob("*.sock"))


def wait_for_daemon(process: subprocess.Popen[str], socket: Path) -> None:
    deadline_s = time.monotonic() + SLOW_S
    while time.monotonic() < deadline_s and process.poll() is None:
        try:
            with Client(socket) as client:
                client.state()
                return
        except SlipguardError:
            pass
        pause(0.05)
    raise AssertionError(f"no daemon: {process.communicate()}")


@pytest.mark.campaign
def test_a_second_daemon_is_refused_a_killed_one_is_replaced(tmp_path_factory: pytest.TempPathFactory) -> None:
    home = tmp_path_factory.mktemp("two")  # a socket's path has 107 bytes
    socket = home / ".local/state/slipguard/slipguard.sock"
    first = start(home, "run", "--sim")
    try:
        wait_for_daemon(first, socket)
        while len(drawing := children(first.pid)) < 2:
            assert first.poll() is None
            pause(0.02)
        second = start(home, "run", "--sim")
        _, err = second.communicate(timeout=SLOW_S)
        assert second.returncode == 1
        assert err == f"slipguard: another daemon is listening at {socket}; stop it first\n"
        with Client(socket) as client:
            assert client.state()["phase"] == "idle"
    finally:
        first.kill()
        first.communicate()
    assert gone(drawing), "the drawing processes outlived a killed daemon"
    assert socket.exists()
    third = start(home, "run", "--sim")
    try:
        wait_for_daemon(third, socket)
    finally:
        third.send_signal(signal.SIGTERM)
        _, err = third.communicate(timeout=SLOW_S)
    assert third.returncode == 0
    assert "slipguard stops; the grip stays as it is" in err
    assert not socket.exists()


INTERRUPTS_ITSELF = "import os, signal; os.kill(os.getpid(), signal.SIGINT); sum(range(100))"
SWALLOWED = f"""
import slipguard.cli.app
def run():
    try:
        {INTERRUPTS_ITSELF}
    except KeyboardInterrupt:
        raise ValueError("what a library made of it") from None
slipguard.cli.app.run = run
"""


@pytest.mark.parametrize("kind", ["while importing", "turned into another error"])
def test_errors_that_libraries_raise_after_ctrl_c_are_not_shown(kind: str, tmp_path: Path) -> None:
    (tmp_path / "numpy.py").write_text(INTERRUPTS_ITSELF)
    before = SWALLOWED if kind == "turned into another error" else "import sys; sys.path.insert(0, '.')"
    command = [sys.executable, "-c", f"{before}\nfrom slipguard.cli import main\nmain()", "check"]
    (tmp_path / "config.toml").write_text("")
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert (done.stdout, done.stderr) == ("", "slipguard: interrupted\n")
