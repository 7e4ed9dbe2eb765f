"""The client finds the daemon of its user, or the system's."""

from __future__ import annotations

import socket
from contextlib import closing
from pathlib import Path

import pytest
from slipguard_ros.local_api import DaemonUnreachable, LocalApi

from slipguard_ros import local_api


@pytest.fixture
def sockets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Path, Path]:
    """Paths of the user's and of the system's socket; the user's daemon was killed, so its file exists."""
    own, system = tmp_path / "slipguard" / "slipguard.sock", tmp_path / "slipguard.sock"
    own.parent.mkdir()
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    monkeypatch.setattr(local_api, "SYSTEM_SOCKET", str(system))
    with closing(socket.socket(socket.AF_UNIX)) as killed:
        killed.bind(str(own))
    return own, system


def listening(path: Path) -> socket.socket:
    path.unlink(missing_ok=True)
    made = socket.socket(socket.AF_UNIX)
    made.bind(str(path))
    made.listen()
    return made


def test_the_first_daemon_that_responds_is_used_from_then_on(sockets: tuple[Path, Path]) -> None:
    own, system = sockets
    with pytest.raises(DaemonUnreachable, match=f"no daemon at {system} .*slipguard run"):
        LocalApi()._connect(1.0)
    with closing(listening(system)):
        api = LocalApi()
        api._connect(1.0).close()
        assert api.socket_path == str(system)
        user_daemon = listening(own)
        api._connect(1.0).close()
        assert api.socket_path == str(system), "no change of the daemon"
        api = LocalApi()
        api._connect(1.0).close()
        assert api.socket_path == str(own)
        user_daemon.close()
        with pytest.raises(DaemonUnreachable, match=str(own)):
            api._connect(1.0)


def test_a_given_socket_is_the_only_one(sockets: tuple[Path, Path], tmp_path: Path) -> None:
    with closing(listening(sockets[0])), pytest.raises(DaemonUnreachable, match="other"):
        LocalApi(str(tmp_path / "other.sock"))._connect(1.0)
