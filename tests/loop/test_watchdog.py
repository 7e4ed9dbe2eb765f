"""Messages to systemd: ready once the loop runs, healthy from the loop's own cycles alone, stopping at the end."""

from __future__ import annotations

import socket
from collections.abc import Iterator
from pathlib import Path

import pytest
from loop_cell import Cell, play

from slipguard.control.control_step import ControlState, control_step
from slipguard.control.messages import Observation, StepOutput
from slipguard.control.params import GuardParams
from slipguard.daemon.lifecycle import notify_systemd, watchdog_period_s

WATCHDOG_S = 3.0


@pytest.fixture
def systemd(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """Listens as systemd does, with WatchdogSec=3."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(str(tmp_path / "notify"))
        listening.setblocking(False)
        monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "notify"))
        monkeypatch.setenv("WATCHDOG_USEC", str(int(WATCHDOG_S * 1e6)))
        yield listening


def messages(listening: socket.socket) -> list[str]:
    received = []
    while True:
        try:
            received.append(listening.recv(500).decode())
        except BlockingIOError:
            return received


def test_a_healthy_loop_feeds_the_watchdog_twice_in_its_time(systemd: socket.socket) -> None:
    received: list[str] = []

    async def scene(cell: Cell) -> None:
        await cell.ready()
        received.extend(messages(systemd))
        for _ in range(10):
            start_s = cell.now_s
            await cell.until(lambda start_s=start_s: cell.now_s >= start_s + WATCHDOG_S)  # type: ignore[misc]
            fed = messages(systemd)
            assert fed.count("WATCHDOG=1") == 2, fed
        await cell.grasp()

    play(Cell(), scene)
    assert received[0] == "READY=1"
    last = messages(systemd)
    assert "STATUS=holding" in last
    assert last[-1] == "STOPPING=1"


def test_a_controller_error_ends_the_service_and_feeds_nothing_more(systemd: socket.socket) -> None:
    """Sensors, gripper and arm go on answering until then: they are no sign of health."""
    rotations = 0

    def broken(state: ControlState, observation: Observation, params: GuardParams) -> tuple[ControlState, StepOutput]:
        nonlocal rotations
        rotations += 1
        if rotations > 50:
            raise ZeroDivisionError("a mistake in the controller")
        return control_step(state, observation, params)

    async def scene(cell: Cell) -> None:
        await cell.until(lambda: False, 20.0)

    with pytest.raises((ExceptionGroup, AssertionError)):
        play(Cell(controller=broken), scene)
    received = messages(systemd)
    assert received.count("WATCHDOG=1") == 1  # in the first cycle
    assert received[-1] == "STOPPING=1"


@pytest.mark.parametrize("raw", ["", "0", "-5", "soon", "3.5"])
def test_without_a_sensible_time_nothing_is_fed(raw: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", raw)
    assert watchdog_period_s() is None


def test_without_systemd_nothing_is_sent(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert notify_systemd("READY=1") is False
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "missing"))
    assert notify_systemd("READY=1") is False
