"""The daemon on a machine with failures: guarding goes on, or a fault with the true reason is latched."""

from __future__ import annotations

import contextlib
import os
import pty
import resource
import signal
import socket
import subprocess
import sys
import termios
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import pytest
from cell_rig import patiently, pause, until, wait_for

from slipguard.daemon.api.client import Client
from slipguard.daemon.api.requests import (
    ClearRequest,
    GraspRequest,
    GuardRequest,
    LiftRequest,
    LowerRequest,
    ReleaseRequest,
)
from slipguard.daemon.store.state_dir import LastGrasp
from slipguard.errors import CommandRefused, SlipguardError

PROGRAM = Path(__file__).with_name("light_daemon.py")
STOP_S = 1.0
"""With the 5 s of a client, the process is suspended for 6 s."""
EXIT_WITHIN_S = 30.0
"""More than the daemon's own limit, on a busy machine."""


class Daemon:
    """The process, its log so far, and its client."""

    def __init__(self, folder: Path, stderr: int, state: Path | None = None, *words: str) -> None:
        self.process = subprocess.Popen(
            [sys.executable, str(PROGRAM), str(folder), str(state or folder / "state"), *words],
            stdin=subprocess.DEVNULL,
            stderr=stderr,
            env={**os.environ, "HOME": str(folder)},
        )
        self.client = Client(folder / "slipguard.sock")

    def state(self) -> dict[str, Any]:
        try:
            return self.client.state()
        except SlipguardError:
            return {}

    def grasp(self) -> None:
        wait_for(self.client, lambda state: not state["waiting_for"], "the devices are not ready")
        patiently(lambda: self.client.submit(GraspRequest()))
        wait_for(self.client, lambda state: state["phase"] == "holding", "not held")

    def lift(self) -> None:
        """Lift; the object slips on the way and is gripped tighter."""
        before_n = self.client.state()["target_force_n"]
        patiently(lambda: self.client.submit(LiftRequest(height_mm=40.0)))
        held = wait_for(self.client, lambda s: s["phase"] == "holding" and s["arm"]["height_mm"] > 35.0, "not lifted")
        assert held["target_force_n"] > before_n, "slip was not answered"

    def stop(self) -> int:
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(EXIT_WITHIN_S)


class Log:
    """The log of a daemon, read by a thread from one end of something."""

    def __init__(self, descriptor: int) -> None:
        self._descriptor, self._text = descriptor, b""
        self._thread = threading.Thread(target=self._read, daemon=True)

    def read(self) -> None:
        self._thread.start()

    def _read(self) -> None:
        with contextlib.suppress(OSError):
            while part := os.read(self._descriptor, 65536):
                self._text += part

    def has(self, text: str) -> bool:
        return text in self._text.decode(errors="replace")


@contextmanager
def running(folder: Path, *words: str, state: Path | None = None) -> Iterator[tuple[Daemon, Log]]:
    """A daemon with its log in a pipe."""
    reader, writer = os.pipe()
    log = Log(reader)
    log.read()
    daemon = Daemon(folder, writer, state, *words)
    os.close(writer)
    try:
        yield daemon, log
    finally:
        daemon.process.send_signal(signal.SIGCONT)
        daemon.process.kill()
        daemon.process.wait()
        daemon.client.close()


class Terminal:
    """A terminal; Ctrl-S stops it, Ctrl-Q starts it again."""

    def __init__(self, folder: Path) -> None:
        self.reader, self.writer = pty.openpty()

    def stall(self) -> None:
        termios.tcflow(self.writer, termios.TCOOFF)

    def go_on(self) -> None:
        termios.tcflow(self.writer, termios.TCOON)

    def close(self) -> None:
        os.close(self.reader)
        os.close(self.writer)


class Journal:
    """systemd's journal, which takes no entry. Its receive queue is short."""

    def __init__(self, folder: Path) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(folder / "journal"))
        self.reader, self.writer = self._socket.fileno(), os.open(os.devnull, os.O_WRONLY)

    def stall(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as other:
            other.setblocking(False)
            with contextlib.suppress(BlockingIOError):
                while True:
                    other.sendto(b"MESSAGE=full\n", self._socket.getsockname())

    def go_on(self) -> None:
        return

    def close(self) -> None:
        self._socket.close()
        os.close(self.writer)


Output = Terminal | Journal


@pytest.mark.campaign
@pytest.mark.parametrize("kind", [Terminal, Journal])
def test_a_log_that_nothing_reads_does_not_stop_the_guard(kind: type[Output], tmp_path: Path) -> None:
    output = kind(tmp_path)
    log = Log(output.reader)
    daemon = Daemon(tmp_path, output.writer)
    try:
        if kind is not Journal:
            until(lambda: daemon.state().get("phase"), "no start", daemon.state)
        daemon.grasp()
        output.stall()
        daemon.lift()
        for on in (False, True) * 3:
            patiently(lambda on=on: daemon.client.submit(GuardRequest(on=on)))  # type: ignore[misc]
        assert daemon.state()["fault"] is None
        output.go_on()
        log.read()
        until(lambda: log.has("lifting by 40 mm"), "not logged", lambda: log._text)
        assert daemon.stop() == 0
    finally:
        daemon.process.kill()
        daemon.process.wait()
        daemon.client.close()
        output.close()


@pytest.mark.campaign
def test_a_full_disk_is_reported_and_the_guard_goes_on(tmp_path: Path) -> None:
    with running(tmp_path) as (daemon, log):
        daemon.grasp()
        resource.prlimit(daemon.process.pid, resource.RLIMIT_FSIZE, (0, resource.RLIM_INFINITY))
        daemon.lift()
        until(lambda: log.has("the grip could not be saved for a restart"), "not reported", lambda: log._text)
        until(lambda: log.has("recording stopped: "), "not reported", lambda: log._text)
        assert daemon.state()["fault"] is None
        assert daemon.stop() == 0


@pytest.mark.campaign
def test_a_state_folder_that_cannot_be_written_is_reported_and_the_guard_goes_on(tmp_path: Path) -> None:
    with running(tmp_path, state=Path("/proc/slipguard")) as (daemon, log):
        daemon.grasp()
        daemon.lift()
        until(lambda: log.has("the grip could not be saved for a restart"), "not reported", lambda: log._text)
        until(lambda: log.has("recording stopped: "), "not reported", lambda: log._text)
        assert daemon.state()["fault"] is None
        assert daemon.stop() == 0


@pytest.mark.campaign
@pytest.mark.parametrize("ahead_s", [5 * 3600.0, -5 * 3600.0])
def test_a_clock_that_is_set_by_hours_changes_nothing(ahead_s: float, tmp_path: Path) -> None:
    """Twice: while the object is held, and while it is lifted and slips."""
    clock = tmp_path / "clock"
    set_hour = f"{datetime.fromtimestamp(time.time() + ahead_s, UTC):%Y-%m-%dT%H}:"
    with running(tmp_path) as (daemon, log):
        daemon.grasp()
        clock.write_text(str(ahead_s))

        def clock_is_set() -> bool:
            daemon.client.submit(GuardRequest(on=True))  # is logged, with the time
            return log.has(f'"timestamp": "{set_hour}')

        until(clock_is_set, "the clock is not set", lambda: log._text, every_s=0.5)
        before_n = daemon.state()["target_force_n"]
        patiently(lambda: daemon.client.submit(LiftRequest(height_mm=60.0)))
        wait_for(daemon.client, lambda state: state["arm"]["height_mm"] > 5.0, "not lifting")
        clock.write_text("0")
        state = wait_for(daemon.client, lambda s: s["phase"] == "holding" and s["arm"]["height_mm"] > 55.0, "no lift")
        assert state["target_force_n"] > before_n, "slip was not answered"
        assert [name for name, finger in state["fingers"].items() if not finger["age_s"] < 1.0] == []
        clock.write_text(str(-ahead_s))
        patiently(lambda: daemon.client.submit(LowerRequest()))
        wait_for(daemon.client, lambda s: s["phase"] == "holding" and s["arm"]["height_mm"] < 5.0, "not lowered")
        saved = LastGrasp.model_validate_json((tmp_path / "state" / "last_grasp.json").read_bytes())
        assert saved.outdated() is None, "a restart would use the grip"
        daemon.client.submit(ReleaseRequest(confirm=True))
        wait_for(daemon.client, lambda state: state["phase"] == "idle", "not released")
        state = daemon.state()
        assert (state["fault"], state["waiting_for"]) == (None, [])
        warnings = [event["text"] for event in state["events"] if event["level"] == "warning"]
        assert not [text for text in warnings if not text.startswith("the load is ")], (
            "only a load that needs more force is reported"
        )
        assert daemon.stop() == 0


@pytest.mark.campaign
def test_a_suspended_process_latches_the_true_reason_and_holds(tmp_path: Path) -> None:
    with running(tmp_path) as (daemon, _):
        daemon.grasp()
        force_n = daemon.state()["gripper"]["force_n"]
        daemon.process.send_signal(signal.SIGSTOP)
        pause(STOP_S)
        with pytest.raises(SlipguardError, match="did not respond"):
            daemon.client.submit(ReleaseRequest(confirm=True))  # its client gives up after 5 s
        daemon.process.send_signal(signal.SIGCONT)
        until(lambda: daemon.state().get("fault"), "no fault", daemon.state)
        fault = daemon.state()["fault"]
        assert fault["code"] == "loop late"
        assert fault["what_to_do"] == "find what keeps the machine busy, then clear"

        def cleared() -> bool:
            with contextlib.suppress(CommandRefused):
                daemon.client.submit(ClearRequest())
            return daemon.state().get("fault", "unknown") is None

        until(cleared, "not cleared", daemon.state)
        state = wait_for(daemon.client, lambda state: state["phase"] == "holding", "not holding")
        assert state["gripper"]["force_n"] >= force_n, "the release of a client that had given up was not executed"
        assert daemon.stop() == 0


@pytest.mark.campaign
def test_a_dead_disk_does_not_keep_the_process_from_ending(tmp_path: Path) -> None:
    with running(tmp_path, "dead-disk") as (daemon, log):
        until(lambda: not daemon.state().get("waiting_for", True), "no start", daemon.state)
        assert daemon.stop() == 1
        until(lambda: log.has("the process exits, the grip stays"), "not reported", lambda: log._text)
        assert log.has('"slipguard_0"'), "the thread is named"


def test_signals_without_a_meaning_are_logged_and_ignored(tmp_path: Path) -> None:
    with running(tmp_path) as (daemon, log):
        until(lambda: not daemon.state().get("waiting_for", True), "no start", daemon.state)
        for number in (signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM):
            ignored = f"{number.name} ignored"
            daemon.process.send_signal(number)
            until(partial(log.has, ignored), f"not logged: {ignored}", lambda: log._text)
        assert daemon.stop() == 0
