"""A ROS client of the node, which spins in a thread."""

from __future__ import annotations

import threading
import time
from collections import defaultdict
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from lifecycle_msgs.srv import ChangeState, GetState
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

TOPICS: dict[str, tuple[Any, Any]] = {
    "/slipguard/state": (String, 10),
    "/slipguard/rotation": (PoseWithCovarianceStamped, 10),
    "/slipguard/grip_force": (WrenchStamped, 10),
    "/slipguard/joint_states": (JointState, 10),
    "/slipguard/left/image_raw": (Image, qos_profile_sensor_data),
    "/slipguard/right/image_raw": (Image, qos_profile_sensor_data),
    "/diagnostics": (DiagnosticArray, 10),
}


class RosClient:
    """received: for each topic, the time at which a message was received, its age in seconds, and the message."""

    def __init__(self) -> None:
        self._context = rclpy.Context()
        rclpy.init(context=self._context)
        self.node = rclpy.create_node("test_client", context=self._context)
        self.received: dict[str, list[tuple[float, float, Any]]] = defaultdict(list)
        for topic, (kind, qos) in TOPICS.items():
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

    def rate_hz(self, topic: str) -> float:
        """Return the rate at which a topic's messages were received."""
        times_s = [one[0] for one in self.received[topic]]
        return (len(times_s) - 1) / (times_s[-1] - times_s[0]) if len(times_s) > 1 else 0.0

    def age_s(self, topic: str) -> float:
        """Return the median age of a topic's messages."""
        ages_s = sorted(one[1] for one in self.received[topic])
        return ages_s[len(ages_s) // 2]

    def call(self, name: str, **fields: Any) -> Any:
        """Call a service of the node; return its response."""
        kind = {"guard": SetBool, "change_state": ChangeState, "get_state": GetState}.get(name, Trigger)
        client = self.node.create_client(kind, f"/slipguard/{name}")
        try:
            assert client.wait_for_service(30.0), f"no service {name}"
            done = threading.Event()
            request = kind.Request()
            for key, value in fields.items():
                setattr(request, key, value)
            future = client.call_async(request)
            future.add_done_callback(lambda _: done.set())
            assert done.wait(40.0), f"no response of {name}"
            return future.result()
        finally:
            self.node.destroy_client(client)

    def transition(self, number: int) -> bool:
        """Request a lifecycle transition; return whether it succeeded."""
        request = ChangeState.Request()
        request.transition.id = number
        return bool(self.call("change_state", transition=request.transition).success)

    def lifecycle(self) -> str:
        """Return the lifecycle state of the node."""
        return str(self.call("get_state").current_state.label)
