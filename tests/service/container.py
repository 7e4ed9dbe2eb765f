"""A booted Debian with systemd as its first process, thrown away afterwards; what it writes lies apart and is seen."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import cell_rig

from slipguard.daemon.api.client import Client
from slipguard.errors import SlipguardError

PATIENCE_S = 120.0
PROGRAM = "/opt/slipguard/bin/slipguard"
UNIT = "slipguard.service"


class Container:
    """root: what is underneath, never written to. work: an empty folder on a real file system, not an overlay."""

    def __init__(self, root: Path, work: Path) -> None:
        self.tree, self.written = work / "tree", work / "written"
        for folder in (self.tree, self.written, work / "overlay"):
            folder.mkdir()
        layers = f"lowerdir={root},upperdir={self.written},workdir={work / 'overlay'}"
        _do("mount", "-t", "overlay", "overlay", "-o", layers, str(self.tree))
        self._console = (work / "console.txt").open("w")
        self._nspawn: subprocess.Popen[str] | None = None
        self._first = 0

    def boot(self) -> None:
        """Start systemd and wait until it is up; without a network, but for the loopback."""
        words = ("--quiet", "--register=no", "--keep-unit", "--private-network", f"--directory={self.tree}", "--boot")
        self._nspawn = subprocess.Popen(
            ["systemd-nspawn", *words],
            stdin=subprocess.DEVNULL,
            stdout=self._console,
            stderr=subprocess.STDOUT,
            text=True,
        )
        children = Path(f"/proc/{self._nspawn.pid}/task/{self._nspawn.pid}/children")
        until(lambda: children.read_text().split(), "no first process", self.console)
        self._first = int(children.read_text().split()[0])
        until(lambda: self.run("systemctl", "is-system-running").stdout.strip() == "running", "not up", self.console)

    def console(self) -> str:
        """What the start said."""
        return Path(self._console.name).read_text()[-2000:]

    def run(self, *words: str, check: bool = False) -> subprocess.CompletedProcess[str]:
        """A command inside."""
        done = subprocess.run(self._inside(*words), capture_output=True, text=True, check=False)
        assert not check or done.returncode == 0, (words, done.returncode, done.stdout, done.stderr)
        return done

    @contextmanager
    def process(self, output: Path, *words: str) -> Iterator[subprocess.Popen[str]]:
        """A program that runs inside meanwhile."""
        with output.open("w") as out:
            running = subprocess.Popen(
                self._inside(*words), stdin=subprocess.PIPE, stdout=out, stderr=subprocess.STDOUT, text=True
            )
        children = Path(f"/proc/{running.pid}/task/{running.pid}/children")
        try:
            yield running
        finally:
            for child in children.read_text().split():  # nsenter waits for it, and hands no signal on
                os.kill(int(child), signal.SIGTERM)
            running.wait(PATIENCE_S)
            assert running.stdin is not None
            running.stdin.close()

    def _inside(self, *words: str) -> list[str]:
        return ["nsenter", f"--target={self._first}", "--all", "--", "env", "-i", "PATH=/usr/bin:/usr/sbin", *words]

    # --- the service ---

    def systemctl(self, *words: str) -> None:
        """`systemctl WORDS... slipguard.service`, which must succeed."""
        self.run("systemctl", *words, UNIT, check=True)

    def shown(self, name: str) -> str:
        """A property of the unit."""
        return self.run("systemctl", "show", "--value", f"--property={name}", UNIT, check=True).stdout.strip()

    def journal(self, *matches: str) -> list[dict[str, Any]]:
        """Entries of the service's own processes; what systemd says of it is of another unit."""
        words = ("journalctl", "--quiet", "--output=json", "--all", "--no-pager", f"_SYSTEMD_UNIT={UNIT}", *matches)
        entries = [json.loads(line) for line in self.run(*words, check=True).stdout.splitlines()]
        for entry in entries:
            message = entry["MESSAGE"]  # a list of bytes where it is not plain text
            entry["MESSAGE"] = message if isinstance(message, str) else bytes(message).decode(errors="replace")
        return entries

    def state(self) -> dict[str, Any]:
        """What the daemon's API says from outside, at less cost than a program; empty where none answers."""
        try:
            with Client(Path(f"/proc/{self._first}/root/run/slipguard/slipguard.sock")) as client:
                return client.state()
        except SlipguardError:
            return {}

    def wait_for(self, good: Callable[[dict[str, Any]], object], otherwise: str) -> dict[str, Any]:
        """The first state that is as it should be."""
        newest: dict[str, Any] = {}

        def reached() -> object:
            nonlocal newest
            newest = self.state()
            return newest and good(newest)

        until(reached, otherwise, lambda: {key: newest.get(key) for key in ("phase", "fault", "waiting_for", "events")})
        return newest

    # --- what was written ---

    def files(self) -> dict[str, tuple[int, int]]:
        """Every file that has been written to since the root was made: path, size and time of the last change."""
        found = {}
        for folder, _, names in os.walk(self.written):
            for name in names:
                path = Path(folder) / name
                with contextlib.suppress(FileNotFoundError):
                    status = path.lstat()
                    found[str(path.relative_to(self.written))] = (status.st_size, status.st_mtime_ns)
        return found

    def stop(self) -> None:
        """Power off and release the folders."""
        if self._nspawn is not None and self._nspawn.poll() is None:
            self.run("systemctl", "poweroff")
            try:
                self._nspawn.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                self._nspawn.kill()
                self._nspawn.wait()
        self._console.close()
        _do("umount", "--lazy", str(self.tree))


def until(reached: Callable[[], object], otherwise: str, what: Callable[[], object]) -> None:
    """Wait for a condition, longer than for a program of one's own."""
    cell_rig.until(reached, otherwise, what, every_s=0.1, within_s=PATIENCE_S)


def _do(*words: str) -> None:
    subprocess.run(words, check=True, capture_output=True)
