"""Measure the guard's latency while the node is killed and restarted, and discovery is flooded.

    python restart_campaign.py .venv/bin/slipguard --restarts 50

An emulated cell, the daemon and the node are processes of their own. Blocks without and with the node alternate, so
that other load on the machine affects both alike. Exits 1 if p99 rises by more than 10 % (and 1 ms), or if the object
is dropped.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
os.environ.setdefault("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))

from ros_client import RosClient
from rosprocesses import NodeProcess, wait_until
from slipguard_ros.local_api import DaemonUnreachable, LocalApi, RequestRefused

WINDOW_S = 18.0
"""The daemon's latency statistics cover its newest 2000 frames: 16.7 s."""
RISE_MAX, RISE_MAX_MS = 0.10, 1.0
IMAGES = "/slipguard/left/image_raw"
FLOOD = """
import rclpy
from std_msgs.msg import String
while True:
    context = rclpy.Context()
    rclpy.init(context=context)
    nodes = [rclpy.create_node(f"flood_{index}", context=context) for index in range(20)]
    publishers = [node.create_publisher(String, f"/flood/topic_{index}", 10) for index, node in enumerate(nodes)]
    rclpy.shutdown(context=context)
"""


def start(program: str, *words: str, priority: list[str] | None = None, log: Path) -> subprocess.Popen[bytes]:
    """Start a slipguard command with its output in a file."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith("PYTHON")}
    with log.open("wb") as out:
        return subprocess.Popen([*(priority or []), program, *words], stdout=out, stderr=out, env=environment)


def ready(api: LocalApi) -> bool:
    """Return whether all devices of the daemon are ready."""
    try:
        return not api.state()["waiting_for"]
    except (DaemonUnreachable, RequestRefused):
        return False


def p99_ms(api: LocalApi) -> float:
    """Return p99 from a frame's arrival to the command, over the newest frames. Raises AssertionError on a fault."""
    state = api.state()
    assert not state["fault"], state["fault"]
    assert state["gripper"]["holding"], "the object was dropped"
    return float(state["latency"]["p99_ms"])


def disturb(socket_path: str, kills: int, ros: RosClient) -> int:
    """Kill and restart the node during one window, while another process floods discovery.

    Returns how often the node published images before it was killed. Raises AssertionError if the flood ended early.
    """
    active = 0
    flood = subprocess.Popen([sys.executable, "-c", FLOOD])
    node = NodeProcess(socket_path)
    try:
        for _ in range(kills):
            ros.received.clear()
            node.start()
            time.sleep(WINDOW_S / kills)
            node.kill()
            active += IMAGES in ros.received
        assert flood.poll() is None, "discovery was not flooded: the process ended"
    finally:
        flood.kill()
        flood.wait()
    return active


def main() -> int:
    """Run the campaign; return the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("slipguard", help="path of the program")
    parser.add_argument("--restarts", type=int, default=50)
    parser.add_argument("--per-block", type=int, default=5)
    parser.add_argument("--as-service", action="store_true", help="with the daemon's real-time priority; needs root")
    given = parser.parse_args()
    priority = ["chrt", "--rr", "2"] if given.as_service else None
    with tempfile.TemporaryDirectory(prefix="sg") as name:
        folder = Path(name)
        cell = start(
            given.slipguard, *f"emulate cell --activated --robot-on --folder {folder}".split(), log=folder / "c"
        )
        config = folder / "config.toml"
        wait_until(lambda: config.exists() and (folder / "left.sock").exists(), "the cell is ready", 60.0)
        daemon = start(given.slipguard, "run", "--config", str(config), priority=priority, log=folder / "d")
        api = LocalApi(str(folder / "slipguard.sock"))
        try:
            wait_until(lambda: ready(api), "the daemon is ready", 60.0)
            api.submit("calibrate", {}, 40.0)
            api.submit("grasp", {})
            wait_until(lambda: api.state()["phase"] == "holding", "the object is held")
            without_ms, with_ms, active, ros = [], [], 0, RosClient()
            for _ in range(-(-given.restarts // given.per_block)):
                time.sleep(WINDOW_S)
                without_ms.append(p99_ms(api))
                active += disturb(api.socket_path, given.per_block, ros)
                with_ms.append(p99_ms(api))
                print(f"p99 without the node {without_ms[-1]:.2f} ms, with restarts {with_ms[-1]:.2f} ms", flush=True)
            ros.close()
            state = api.state()
        finally:
            for process in (daemon, cell):
                process.terminate()
                process.wait(30.0)
    without, disturbed = statistics.median(without_ms), statistics.median(with_ms)
    allowed_ms = max(RISE_MAX * without, RISE_MAX_MS)
    print(
        f"{given.restarts} restarts, {active} of them with images: "
        f"p99 {without:.2f} ms without, {disturbed:.2f} ms with them "
        f"(limit {without + allowed_ms:.2f} ms); "
        f"phase {state['phase']}, fault {state['fault']}, deadlines missed {state['deadlines_missed']}"
    )
    return int(disturbed > without + allowed_ms)


if __name__ == "__main__":
    sys.exit(main())
