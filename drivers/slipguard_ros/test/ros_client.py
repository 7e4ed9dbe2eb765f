"""The node as a process, and a ROS client that spins in a thread."""

from __future__ import annotations

import signal
import subprocess
import sys
import threading
import time
from collections import defaultdict
from functools import partial
from pathlib import Path
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from lifecycle_msgs.srv import ChangeState
from rclpy.action import ActionClient
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, JointState
from slipguard_ros.interfaces import SERVICES

from slipguard_ros_interfaces.msg import SlipEstimate, State

TOPICS: dict[str, tuple[Any, Any]] = {
    "/slipguard/state": (State, 10),
    "/slipguard/slip": (SlipEstimate, 10),
    "/slipguard/rotation": (PoseWithCovarianceStamped, 10),
    "/slipguard/grip_force": (WrenchStamped, 10),
    "/slipguard/joint_states": (JointState, 10),
    "/slipguard/left/image_raw": (Image, qos_profile_sensor_data),
    "/slipguard/right/image_raw": (Image, qos_profile_sensor_data),
    "/diagnostics": (DiagnosticArray, 10),
}
WITHOUT_INTERFACES = (
    "import sys; sys.modules['slipguard_ros_interfaces'] = None; from slipguard_ros.node import main; main()"
)


class NodeProcess:
    """The node, `slipguard_node`. typed: False: as where slipguard_ros_interfaces is not installed."""

    def __init__(
        self, socket_path: str, *parameters: str, parameter_file: Path | None = None, typed: bool = True
    ) -> None:
        words = [] if parameter_file is None else ["--params-file", str(parameter_file)]
        words += [word for one in (f"socket:={socket_path}", *parameters) for word in ("-p", one)]
        program = ["-m", "slipguard_ros.node"] if typed else ["-c", WITHOUT_INTERFACES]
        self._command = [sys.executable, *program, "--ros-args", *words]

    def __enter__(self) -> NodeProcess:
        self._process = subprocess.Popen(self._command)
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGINT)  # as ros2 launch does
        assert self._process.wait(20.0) == 0, "the node did not end cleanly"


class RosClient:
    """received: for each topic, the time at which a message was received, its age in seconds, and the message."""

    def __init__(self, topics: dict[str, tuple[Any, Any]] = TOPICS) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("test_client", context=self._context)
        self.received: dict[str, list[tuple[float, float, Any]]] = defaultdict(list)
        for topic, (kind, qos) in topics.items():
            self.node.create_subscription(kind, topic, partial(self._receive, topic), qos)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self.node)
        self._thread = threading.Thread(target=self._executor.spin, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """End the client."""
        self._executor.shutdown()
        rclpy.shutdown(context=self._context)
        self._thread.join(5.0)

    def _receive(self, topic: str, message: Any) -> None:
        age_s = 0.0
        if hasattr(message, "header"):
            stamp = message.header.stamp
            age_s = 1e-9 * (self.node.get_clock().now().nanoseconds - stamp.sec * 10**9 - stamp.nanosec)
        self.received[topic].append((time.monotonic(), age_s, message))

    def newest(self, topic: str) -> Any:
        """Return the newest message of a topic."""
        return self.received[topic][-1][2]

    def result(self, future: Any) -> Any:
        """Wait for a future and return its result."""
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(60.0), "no response"
        return future.result()

    def call(self, name: str, **fields: Any) -> Any:
        """Call a service of the node; return its response."""
        kind = {"change_state": ChangeState, **SERVICES}[name]
        client = self.node.create_client(kind, f"/slipguard/{name}")
        try:
            assert client.wait_for_service(30.0), f"no service {name}"
            return self.result(client.call_async(kind.Request(**fields)))
        finally:
            self.node.destroy_client(client)

    def transition(self, number: int) -> bool:
        """Request a lifecycle transition; return whether it succeeded."""
        request = ChangeState.Request()
        request.transition.id = number
        return bool(self.call("change_state", transition=request.transition).success)


class Goals:
    """Sends goals to an action of the node. feedback: all that was received."""

    def __init__(self, ros: RosClient, kind: Any, name: str) -> None:
        self.ros, self.kind = ros, kind
        self.client = ActionClient(ros.node, kind, f"/slipguard/{name}")
        assert self.client.wait_for_server(30.0)
        self.feedback: list[Any] = []

    def send(self, goal: Any) -> Any:
        """Send a goal; return its handle."""
        handle = self.ros.result(self.client.send_goal_async(goal, lambda one: self.feedback.append(one.feedback)))
        assert handle.accepted
        return handle

    def run(self, goal: Any) -> tuple[int, Any]:
        """Send a goal and return its status and result."""
        response = self.ros.result(self.send(goal).get_result_async())
        return response.status, response.result
