"""A cell without hardware as the README shows it: every command that talks to a daemon, then its recordings."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from cell_rig import Cell, cell, daemon, patiently, wait_for
from ur_scene import own_address

from slipguard.cli.app import run
from slipguard.daemon.api.client import Client
from slipguard.errors import CommandRefused

OPTIONS = ("--object", "wrench", "--seed", 0, "--fps", 30, "--height-mm", 40)


def free_address() -> str:
    """An address of this machine without a listener."""
    with socket.create_server(("127.0.0.1", 0)) as free:
        return f"127.0.0.1:{free.getsockname()[1]}"


class Terminal:
    """Runs `slipguard WORDS...` in this process."""

    def __init__(self, capfd: pytest.CaptureFixture[str], there: Cell) -> None:
        self._capfd, self._socket = capfd, str(there.folder / "slipguard.sock")

    def run(self, *words: object, code: int = 0) -> str:
        """What it printed; it must end with `code`."""
        self._capfd.readouterr()
        ended = run([str(word) for word in words])
        said = self._capfd.readouterr()
        assert ended == code, said.out + said.err
        return said.out + said.err

    def ctl(self, *words: object, code: int = 0) -> str:
        """`slipguard ctl WORDS...` at the cell's socket."""
        return self.run("ctl", "--socket", self._socket, *words, code=code)

    def patiently(self, *words: object) -> None:
        """The same, until it is not refused: a device may just have been late on a busy machine."""

        def once() -> None:
            self._capfd.readouterr()
            if run(["ctl", "--socket", self._socket, *map(str, words)]) != 0:
                raise CommandRefused(self._capfd.readouterr().err)

        patiently(once)


@pytest.fixture
def there(tmp_path: Path) -> Iterator[Cell]:
    with cell(tmp_path, own_address(67), *OPTIONS, activated=False) as made:
        yield made


@pytest.mark.campaign
def test_every_command_of_a_guarded_cell(there: Cell, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    terminal = Terminal(capfd, there)
    there.config.write_text(there.config.read_text().replace("[api]\n", f'[api]\nlisten = "{free_address()}"\n'))
    assert "valid" in terminal.run("check", "--config", there.config)
    with daemon(there) as client:
        assert "slipguard ctl activate" in terminal.ctl("gripper", "--width-mm", 60, code=1)
        terminal.patiently("activate", "--yes")
        assert "already activated" in terminal.ctl("activate", "--yes", code=1)
        terminal.patiently("calibrate")
        terminal.run("calibrate", "--config", there.config)
        _drive(terminal, client)
        _frames(terminal, there, tmp_path)
    _replay(terminal, there, tmp_path)


def _drive(terminal: Terminal, client: Client) -> None:
    """Everything `slipguard ctl` can say, in an order that makes sense."""

    def reach(phase: str) -> dict[str, Any]:
        return wait_for(client, lambda state: state["phase"] == phase and not state["gripper"]["moving"], phase)

    assert json.loads(terminal.ctl("state", "--json"))["phase"] == "idle"
    assert "/login?token=" in terminal.ctl("page")
    assert "no fault is latched" in terminal.ctl("clear", code=1)
    terminal.ctl("gripper", "--width-mm", 60)
    wait_for(client, lambda state: state["gripper"]["width_mm"] < 61.0, "the jaws do not move")
    terminal.patiently("grasp")
    reach("holding")
    assert "would drop it" in terminal.ctl("gripper", "--width-mm", 80, code=1)
    terminal.ctl("guard", "off")
    terminal.ctl("guard", "on")
    terminal.patiently("lift")
    wait_for(client, lambda state: state["arm"]["height_mm"] > 35.0 and state["phase"] == "holding", "no lift")
    terminal.patiently("lower")
    wait_for(client, lambda state: state["arm"]["height_mm"] < 1.0 and state["phase"] == "holding", "still up")
    terminal.ctl("release", "--yes")
    reach("idle")


def _frames(terminal: Terminal, there: Cell, tmp_path: Path) -> None:
    """Frames from the running daemon become a data set."""
    presses, sheet = tmp_path / "presses", tmp_path / "sheet.png"
    config = ("--config", there.config)
    terminal.run("dataset", "record", *config, "--out", presses, "--count", 4, "--every-s", 0.05)
    terminal.run("dataset", "show", presses, "--out", sheet)
    assert sheet.stat().st_size > 1000


def _replay(terminal: Terminal, there: Cell, tmp_path: Path) -> None:
    """What the daemon recorded gives the very same commands, and comes apart into plain files."""
    recordings = there.folder / "state" / "recordings"
    folders = [folder for folder in (recordings / "ring", recordings / "kept") if any(folder.glob("*.mcap"))]
    played = json.loads(terminal.run("replay", *folders, "--json"))
    assert played["ticks"] > 500
    assert (played["commands_differ"], played["damage"]) == (0, [])
    assert played["frames_replayed"] > 20
    assert {"closing", "lifting", "lowering"} <= {one["phase"] for one in played["phases"]}
    out = tmp_path / "apart"
    terminal.run("replay", folders[0], "--export", out, "--as", "csv", "--as", "mp4", "--as", "png")
    suffixes = {path.suffix for path in out.rglob("*") if path.is_file()}
    assert {".csv", ".mp4", ".png"} <= suffixes
