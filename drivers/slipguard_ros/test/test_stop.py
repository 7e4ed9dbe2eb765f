"""The service `stop` waits for no other call. How soon the arm rests after it is timed in `test_actions.py`."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from ros_client import NodeProcess, RosClient
from slipguard_ros.interfaces import SERVICES

BLOCKING = ("grasp", "lift", "lower", "clear", "release")
ANSWER = b'{"message": "stopped by request"}'


@pytest.fixture
def silent_daemon(tmp_path: Path) -> Iterator[str]:
    """A daemon that answers `stop` and nothing else; yields its socket's path."""
    path, connections = str(tmp_path / "s"), list[socket.socket]()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(path)
        listening.listen(32)

        def serve() -> None:
            with contextlib.suppress(OSError):  # raised at the end
                while True:
                    made, _ = listening.accept()
                    connections.append(made)
                    if made.recv(4096).startswith(b"POST /stop"):
                        made.sendall(b"HTTP/1.1 200 OK\r\ncontent-length: %d\r\n\r\n%s" % (len(ANSWER), ANSWER))

        thread = threading.Thread(target=serve)
        thread.start()
        yield path
        listening.shutdown(socket.SHUT_RDWR)
        thread.join(5.0)
        for one in connections:
            one.close()


def test_it_does_not_wait_for_other_calls(silent_daemon: str, ros: RosClient) -> None:
    with NodeProcess(silent_daemon):
        waiting = []
        for name in BLOCKING:
            client = ros.node.create_client(SERVICES[name], f"/slipguard/{name}")
            assert client.wait_for_service(30.0)
            waiting += [client.call_async(SERVICES[name].Request()) for _ in range(3)]
        time.sleep(0.5)
        response = ros.call("stop")
        assert (response.success, response.message) == (True, "stopped by request")
        assert not any(call.done() for call in waiting), "they wait for 6 s"
