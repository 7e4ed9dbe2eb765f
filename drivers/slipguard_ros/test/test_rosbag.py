"""A recording becomes a rosbag2 whose messages rclpy reads."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import pytest
from daemon_processes import Daemon
from rclpy.serialization import deserialize_message
from rosbags.rosbag2 import Reader

EXPECTED = {
    "/slipguard/left/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/slipguard/right/image_raw/compressed": "sensor_msgs/msg/CompressedImage",
    "/slipguard/joint_states": "sensor_msgs/msg/JointState",
    "/slipguard/rotation": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "/slipguard/tick": "std_msgs/msg/String",
    "/slipguard/left/judged": "std_msgs/msg/String",
    "/rosout": "rcl_interfaces/msg/Log",
}


def message_type(name: str) -> type:
    """Return the class of a type such as `std_msgs/msg/String`."""
    package, _, kind = name.partition("/msg/")
    return getattr(importlib.import_module(f"{package}.msg"), kind)


def test_a_recording_becomes_a_bag(daemon: Daemon, tmp_path: Path) -> None:
    daemon.grasp()
    time.sleep(1.0)
    recording = max((daemon.folder / "state" / "recordings").rglob("*.mcap"), key=lambda path: path.stat().st_size)
    words = [str(recording), str(tmp_path / "bag")]
    done = subprocess.run([sys.executable, "-m", "slipguard_ros.rosbag", *words], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "messages written" in done.stdout
    counts: Counter[str] = Counter()
    newest = {}
    with Reader(tmp_path / "bag") as reader:
        types = {connection.topic: connection.msgtype for connection in reader.connections}
        for connection, at_ns, data in reader.messages():
            counts[connection.topic] += 1
            newest[connection.topic] = deserialize_message(bytes(data), message_type(connection.msgtype))
            assert at_ns > 10**18
    assert EXPECTED.items() <= types.items()
    assert counts["/slipguard/tick"] > 50
    assert newest["/slipguard/left/image_raw/compressed"].format == "jpeg"
    assert bytes(newest["/slipguard/left/image_raw/compressed"].data[:2]) == b"\xff\xd8"
    assert newest["/slipguard/rotation"].pose.covariance[0] == -1.0, "not measured"
    gripper = json.loads(newest["/slipguard/tick"].data)["observation"]["gripper"]
    assert newest["/slipguard/joint_states"].effort[0] == gripper["force_n"]
    assert newest["/slipguard/joint_states"].position[0] == pytest.approx(gripper["width_mm"] / 1000.0)
    again = subprocess.run([sys.executable, "-m", "slipguard_ros.rosbag", *words], capture_output=True, text=True)
    assert (again.returncode, "exists" in again.stderr) == (1, True)
