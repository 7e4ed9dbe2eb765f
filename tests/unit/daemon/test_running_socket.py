"""Commands that open the devices themselves find the socket of a running daemon."""

from __future__ import annotations

import socket
import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from command_line import slipguard

from slipguard.config import Config, sim_config
from slipguard.daemon.api import paths
from slipguard.daemon.api.paths import running_socket, socket_path

CONFIG = """
[left]
driver = "replay"
replay.path = "/nowhere"
[right]
driver = "replay"
replay.path = "/nowhere"
[gripper]
driver = "fake"
[arm]
driver = "fake"
"""
REFUSED = b"HTTP/1.1 409 Conflict\r\ncontent-length: 26\r\nconnection: close\r\n\r\n" + b'{"error": "asked the one"}'


@pytest.fixture
def config(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Config:
    """Nothing configured; the user's folder and the system's are empty ones."""
    (tmp_path / "system").mkdir()
    (tmp_path / "own").mkdir()
    monkeypatch.setattr(paths, "SYSTEM_FOLDER", tmp_path / "system")
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(tmp_path / "own"))
    return sim_config()


def system() -> Path:
    return paths.SYSTEM_FOLDER / "slipguard.sock"


@contextmanager
def listening(path: Path) -> Iterator[Path]:
    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        yield path


def test_the_users_daemon_is_found_before_the_systems(config: Config) -> None:
    own = socket_path(config)
    for asked in (config, None):
        assert running_socket(asked) == own, "where one would be"
    with ExitStack() as daemons:
        daemons.enter_context(listening(system()))
        for asked in (config, None):
            assert running_socket(asked) == system()
        daemons.enter_context(listening(own))
        for asked in (config, None):
            assert running_socket(asked) == own


def test_a_socket_of_a_dead_daemon_does_not_hide_a_running_one(config: Config) -> None:
    with listening(socket_path(config)):
        pass
    assert socket_path(config).exists()
    with listening(system()):
        assert running_socket(config) == system()


def test_a_configured_socket_is_the_only_one(config: Config, tmp_path: Path) -> None:
    named = config.model_copy(update={"api": config.api.model_copy(update={"socket": tmp_path / "named.sock"})})
    with listening(system()):
        assert running_socket(named) == tmp_path / "named.sock"


def test_a_daemon_without_access_permission_is_found(config: Config, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its devices are in use all the same."""

    def connect(self: socket.socket, address: str) -> None:
        raise PermissionError if address == str(system()) else FileNotFoundError

    monkeypatch.setattr(socket.socket, "connect", connect)
    assert running_socket(config) == system()


@contextmanager
def refusing(path: Path) -> Iterator[None]:
    """A daemon that refuses everything."""

    def answer(server: socket.socket) -> None:
        while True:
            try:
                asked, _ = server.accept()
            except OSError:
                return
            with asked:
                if asked.recv(65536):
                    asked.sendall(REFUSED)

    with socket.socket(socket.AF_UNIX) as server:
        server.bind(str(path))
        server.listen()
        thread = threading.Thread(target=answer, args=(server,))
        thread.start()
        try:
            yield
        finally:
            server.shutdown(socket.SHUT_RDWR)
            thread.join()


@pytest.mark.parametrize("command", ["calibrate", "dataset record --out {}/new", "doctor"])
def test_the_systems_daemon_is_used_and_no_device_opened(
    command: str, config: Config, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "config.toml").write_text(CONFIG)
    with refusing(system()):
        ran = slipguard(capfd, *command.format(tmp_path).split(), "--config", tmp_path / "config.toml")
    assert ran.code == 1
    assert "asked the one" in ran.out + ran.err
    assert "nowhere" not in ran.out + ran.err


def test_one_sensor_is_not_taken_from_the_systems_daemon(
    config: Config, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with refusing(system()):
        ran = slipguard(capfd, "dataset", "record", "--serial", "D20479", "--out", tmp_path / "new")
    assert ran.complaint == "refused: asked the one"
