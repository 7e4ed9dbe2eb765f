"""The service `stop`: it waits for no other call, and ends a lift on the emulated cell within 60 ms of its call."""

from __future__ import annotations

import contextlib
import json
import os
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from ros_client import RosClient
from rosprocesses import CONFIG, NodeProcess, wait_until
from slipguard_ros.local_api import DaemonUnreachable, LocalApi, RequestRefused
from std_srvs.srv import Trigger

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
        clients = [ros.node.create_client(Trigger, f"/slipguard/{name}") for name in BLOCKING]
        assert all(client.wait_for_service(30.0) for client in clients)
        waiting = [client.call_async(Trigger.Request()) for client in clients for _ in range(3)]
        time.sleep(0.5)
        response = ros.call("stop")
        assert (response.success, response.message) == (True, "stopped by request")
        assert not any(call.done() for call in waiting), "they wait for 6 s"


def start(python: str, words: str, log: Path) -> subprocess.Popen[bytes]:
    """Start a slipguard command with its output in a file."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    with log.open("wb") as out:
        return subprocess.Popen([python, "-m", "slipguard", *words.split()], stdout=out, stderr=out, env=environment)


def ready(api: LocalApi) -> bool:
    try:
        return not api.state()["waiting_for"]
    except (DaemonUnreachable, RequestRefused):
        return False


@contextlib.contextmanager
def emulated_cell(python: str, folder: Path) -> Iterator[LocalApi]:
    """An emulated cell and its daemon, calibrated, with an object between the open jaws."""
    options = "--activated --robot-on --object bar --seed 3 --fps 30 --host 127.0.0.77"
    running = [start(python, f"emulate cell {options} --folder {folder}", folder / "cell.txt")]
    config, tuning = folder / "config.toml", CONFIG[CONFIG.index("[guard.tuning]") :]
    try:
        wait_until(lambda: config.exists() and (folder / "left.sock").exists(), "the cell is ready", 60.0)
        patient = folder / "patient.toml"
        patient.write_text(f"{config.read_text()}\n{tuning}")
        running.append(start(python, f"run --config {patient}", folder / "daemon.txt"))
        api = LocalApi(str(folder / "slipguard.sock"))
        wait_until(lambda: ready(api), "the daemon is ready", 60.0)
        api.submit("calibrate", {}, 40.0)
        yield api
    finally:
        for process in reversed(running):
            process.terminate()
            process.wait(30.0)


def rested_s(folder: Path) -> float:
    """Return when the arm came to rest, on the monotonic clock, from the cell's log of the truth."""
    lines = [json.loads(line) for line in (folder / "truth.jsonl").read_text().splitlines() if line.endswith("}")]
    return float(next(line["t"] for line in lines if line["height"] == lines[-1]["height"]))


def test_it_ends_a_lift_within_60_ms(tmp_path: Path, slipguard_python: str, ros: RosClient) -> None:
    took_s = []
    with emulated_cell(slipguard_python, tmp_path) as api, NodeProcess(api.socket_path):
        stop = ros.node.create_client(Trigger, "/slipguard/stop")
        assert stop.wait_for_service(30.0)
        wait_until(lambda: ros.call("guard", data=True).message != "the node is not active; activate it", "active")
        api.submit("grasp", {"force_n": 120.0})
        for number in range(TIMES):
            wait_until(lambda: api.state()["phase"] == "holding", "the object is held")
            time.sleep(1.0)
            api.submit("lift", {"height_mm": 60.0 - number, "speed_mm_s": 50.0})
            wait_until(lambda: (api.state()["lifted_mm"] or 0.0) > 20.0, "the arm lifts")
            called_s, done = time.monotonic(), threading.Event()
            call = stop.call_async(Trigger.Request())
            call.add_done_callback(lambda _, done=done: done.set())
            assert done.wait(10.0)
            assert call.result().message.startswith("stopped by request")
            wait_until(lambda: not api.state()["arm"]["moving"], "the arm stands")
            state = api.state()
            assert (state["phase"], state["stopped_by_request"], state["fault"]) == ("holding", True, None)
            assert state["lifted_mm"] < 50.0
            time.sleep(0.2)
            took_s.append(rested_s(tmp_path) - called_s)
            api.submit("lower", {})
            wait_until(lambda: api.state()["lifted_mm"] < 1.0 and api.state()["phase"] == "holding", "it is lowered")
    print([round(1000.0 * one) for one in took_s], "ms")
    if max(took_s) > WITHIN_S and os.getloadavg()[0] > (os.cpu_count() or 1):
        print(f"NOT JUDGED: the time to stop; this machine is too busy: {took_s}")
        return
    assert max(took_s) <= WITHIN_S
