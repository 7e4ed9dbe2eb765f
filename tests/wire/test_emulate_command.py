"""`slipguard emulate` as a person and a program use it."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import serial

ASK = bytes.fromhex("09 04 07D0 0003 B1CE")


@pytest.fixture
def link(tmp_path: Path) -> Path:
    return tmp_path / "ttyGR"


def start(*words: object) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "slipguard", "emulate", *map(str, words)],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.fixture
def program(link: Path) -> Iterator[subprocess.Popen[str]]:
    running = start("robotiq", "--link", link, "--object-width-mm", 40, "--fault", "late:0.0", "--json")
    with running:
        yield running
        running.kill()


def expected(running: subprocess.Popen[str]) -> dict[str, Any]:
    assert running.stdout is not None
    return dict(json.loads(running.stdout.readline()))


def say(running: subprocess.Popen[str], words: str) -> dict[str, Any]:
    assert running.stdin is not None
    running.stdin.write(words + "\n")
    running.stdin.flush()
    return expected(running)


def test_a_program_starts_it_talks_to_it_and_ends_it(program: subprocess.Popen[str], link: Path) -> None:
    assert expected(program) == {"ready": str(link), "emulator": "robotiq"}
    with serial.Serial(str(link), 115200, timeout=1.0) as port:
        port.write(ASK)
        assert len(port.read(11)) == 11
    state = say(program, "state")["state"]
    assert (state["stage"], state["requests"]) == ("off", 1)
    assert say(program, "fault silence 1") == {"answer": "silence: 1 times more"}
    assert "no fault 'nonsense'" in say(program, "fault nonsense")["refused"]
    with serial.Serial(str(link), 115200, timeout=0.1) as port:
        port.write(ASK)
        assert port.read(11) == b""
    event = expected(program)
    assert (event["event"], event["kind"]) == ("fault", "silence")
    program.send_signal(signal.SIGTERM)
    assert program.wait(5.0) == 0
    assert not link.is_symlink()


@pytest.mark.parametrize(
    ("words", "where", "ends"),
    [
        (["robotiq"], "robotiq emulated at /dev/pts/", "quit"),
        (["robotiq"], "robotiq emulated at /dev/pts/", signal.SIGINT),
        (["digit", "--port", "0"], "digit emulated at 127.0.0.1:", "quit"),
    ],
)
def test_ctrl_c_ends_it_without_a_traceback(words: list[str], where: str, ends: str | signal.Signals) -> None:
    with start(*words) as running:
        assert running.stdout is not None
        assert where in running.stdout.readline()
        if isinstance(ends, str):
            out, complaint = running.communicate(ends + "\n", timeout=5.0)
        else:
            running.send_signal(ends)
            out, complaint = running.communicate(timeout=5.0)
    assert (running.returncode, complaint, out) == (0, "", "")


def test_without_stdin_it_continues(link: Path) -> None:
    with start("robotiq", "--link", link) as running:
        assert running.stdout is not None
        assert running.stdin is not None
        running.stdout.readline()
        running.stdin.close()
        with pytest.raises(subprocess.TimeoutExpired):
            running.wait(0.5)
        running.terminate()


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["nothing"], "no such command 'nothing'"),
        (["robotiq", "--fault", "never"], "no fault 'never'"),
        (["robotiq", "--fault", "late:often"], "neither a probability"),
        (["robotiq", "--object-width-mm", "300"], "less than 140"),
        (["robotiq", "--link", "/proc/tty"], "is not a link"),
        (["robotiq", "--colour", "red"], "--colour"),
    ],
)
def test_misuse_is_one_line(words: list[str], says: str, capfd: pytest.CaptureFixture[str]) -> None:
    from slipguard.cli.app import run

    assert run(["emulate", *words]) == 2
    complaint = capfd.readouterr().err
    assert says in complaint
    assert complaint.count("\n") == 1
