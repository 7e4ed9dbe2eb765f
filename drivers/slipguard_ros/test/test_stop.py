"""The service `stop`: it waits for no other call, and ends a lift on the emulated cell within 60 ms of its call."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from daemon_processes import EmulatedCell, wait_until
from ros_client import NodeProcess, RosClient
from slipguard_ros.interfaces import SERVICES

BLOCKING = ("grasp", "lift", "lower", "clear", "release")
ANSWER = b'{"message": "stopped by request"}'
WITHIN_S = 0.06
TIMES = 5


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


def rested_s(folder: Path) -> float:
    """Return when the arm came to rest, on the monotonic clock, from the cell's log of the truth."""
    lines = [json.loads(line) for line in (folder / "truth.jsonl").read_text().splitlines() if line.endswith("}")]
    return float(next(line["t"] for line in lines if line["height"] == lines[-1]["height"]))


def test_it_ends_a_lift_within_60_ms(tmp_path: Path, slipguard_python: str, ros: RosClient) -> None:
    took_s = []
    with EmulatedCell(slipguard_python, tmp_path, placed="bar 3") as cell, NodeProcess(cell.socket):
        wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
        cell.grasp(force_n=120.0)
        for _ in range(TIMES):
            wait_until(lambda: cell.state()["phase"] == "holding", "the object is held")
            time.sleep(1.0)
            cell.api.submit("lift", {"height_mm": 60.0, "speed_mm_s": 50.0})
            wait_until(lambda: (cell.state()["lifted_mm"] or 0.0) > 20.0, "the arm lifts")
            called_s = time.monotonic()
            assert ros.call("stop").message.startswith("stopped by request")
            wait_until(lambda: not cell.state()["arm"]["moving"], "the arm stands")
            state = cell.state()
            assert (state["phase"], state["stopped_by_request"], state["fault"]) == ("holding", True, None)
            assert state["lifted_mm"] < 50.0
            time.sleep(0.2)
            took_s.append(rested_s(tmp_path) - called_s)
            cell.api.submit("lower")
            wait_until(lambda: cell.state()["lifted_mm"] < 1.0 and cell.state()["phase"] == "holding", "lowered")
    print([round(1000.0 * one) for one in took_s], "ms")
    if max(took_s) > WITHIN_S and os.getloadavg()[0] > (os.cpu_count() or 1):
        print(f"NOT JUDGED: the time to stop; this machine is too busy: {took_s}")
        return
    assert max(took_s) <= WITHIN_S
