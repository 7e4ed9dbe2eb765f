"""Two daemons that start at the same time: one gets the socket, the other reports it."""

from __future__ import annotations

import contextlib
import socket
import threading
from pathlib import Path

import pytest

from slipguard.errors import SlipguardError
from slipguard.web.sockets import UnixSocket, bind

SETTLE_S = 0.2


def leave_stale_socket(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as dead:
        dead.bind(str(path))


def start_two(path: Path) -> tuple[list[UnixSocket], list[str]]:
    bound, refused = list[UnixSocket](), list[str]()

    def start() -> None:
        try:
            bound.append(bind(path))
        except SlipguardError as error:
            refused.append(str(error))

    starting = [threading.Thread(target=start) for _ in range(2)]
    for thread in starting:
        thread.start()
    for thread in starting:
        thread.join(30.0)
    return bound, refused


def test_of_two_starts_over_a_stale_socket_one_binds(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The second start finds the socket stale, and removes it only after the first has bound its own."""
    path = tmp_path / "slipguard.sock"
    leave_stale_socket(path)
    both_found_it, first, unlink = threading.Barrier(2), threading.Lock(), Path.unlink

    def unlink_late(file: Path, missing_ok: bool = False) -> None:
        with contextlib.suppress(threading.BrokenBarrierError):  # the other one waits its turn, as it should
            both_found_it.wait(SETTLE_S)
        if not first.acquire(blocking=False):
            threading.Event().wait(SETTLE_S)
        unlink(file, missing_ok)

    monkeypatch.setattr(Path, "unlink", unlink_late)
    bound, refused = start_two(path)
    monkeypatch.undo()
    assert len(bound) == 1
    assert refused == [f"another daemon is listening at {path}; stop it first"]
    bound[0].close()
    assert not path.exists()


def test_a_daemon_that_ends_leaves_the_socket_of_the_next_one(tmp_path: Path) -> None:
    path = tmp_path / "slipguard.sock"
    old = bind(path)
    path.unlink()
    new = bind(path)
    old.close()
    assert path.exists()
    new.close()
