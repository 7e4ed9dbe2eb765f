"""Grasp and lift in a simulated cell through ROS, with and without the guard: `slipguard_ros_demo SLIPGUARD PLOT`."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from slipguard_demo import EmulatedCell, plot, wait_until
from std_srvs.srv import SetBool

from slipguard_ros.interfaces import call

ROTATION, FORCE = "rotation [deg]", "grip force [N]"
LIFT_TIMEOUT_S = 60.0
AFTER_S = 1.0


class Demo:
    """A node that calls the services and receives rotation and force. curves: times of capture and values."""

    def __init__(self, cell: EmulatedCell) -> None:
        self.cell, self.node = cell, rclpy.create_node("slipguard_demo")
        self.curves: dict[str, list[tuple[float, float]]] = {}
        self.node.create_subscription(PoseWithCovarianceStamped, "/slipguard/rotation", self._on_rotation, 10)
        self.node.create_subscription(WrenchStamped, "/slipguard/grip_force", self._on_force, 10)

    def episode(self, guarded: bool) -> dict[str, list[tuple[float, float]]]:
        """Grasp and lift the object; return rotation and force by time of capture."""
        self._request("grasp")
        self.curves = {ROTATION: [], FORCE: []}
        self._wait_for("holding")
        self._request("guard", SetBool.Request(data=guarded))
        self._request("lift")
        self._wait_for("lifting", "fault")
        self._wait_for("holding", "fault")
        until_s = time.monotonic() + AFTER_S
        self._wait(lambda: time.monotonic() > until_s, "some time")
        curves = self.curves
        self.cell.release()
        return {label: sorted(values) for label, values in curves.items()}

    def _on_rotation(self, message: PoseWithCovarianceStamped) -> None:
        orientation = message.pose.pose.orientation
        self._add(ROTATION, message, math.degrees(2.0 * math.atan2(orientation.z, orientation.w)))

    def _on_force(self, message: WrenchStamped) -> None:
        self._add(FORCE, message, message.wrench.force.z)

    def _add(self, label: str, message: Any, value: float) -> None:
        stamp = message.header.stamp
        self.curves.setdefault(label, []).append((stamp.sec % 86400 + 1e-9 * stamp.nanosec, value))

    def _request(self, service: str, request: Any = None) -> None:
        """Call a service until it accepts: the node may not be active yet, the grip not firm yet."""

        def accepted() -> bool:
            response = call(self.node, service, request)
            return response is not None and response.success

        wait_until(accepted, f"/slipguard/{service} accepts the request")

    def _wait_for(self, *phases: str) -> None:
        self._wait(lambda: self.cell.state()["phase"] in phases, f"phase {' or '.join(phases)}")

    def _wait(self, reached: Any, what: str) -> None:
        def spun() -> bool:
            rclpy.spin_once(self.node, timeout_sec=0.02)
            return bool(reached())

        wait_until(spun, what, LIFT_TIMEOUT_S)


def main() -> int:
    """Run both episodes and write the plot; return the exit status."""
    if len(sys.argv) != 3:
        print("usage: slipguard_ros_demo SLIPGUARD PLOT.png, such as .venv/bin/slipguard slip.png", file=sys.stderr)
        return 2
    program, path = sys.argv[1:]
    rclpy.init()
    with tempfile.TemporaryDirectory(prefix="sg") as folder, EmulatedCell([program], Path(folder) / "cell") as cell:
        command = [sys.executable, "-m", "slipguard_ros.node", "--ros-args", "-p", f"socket:={cell.socket}"]
        node = subprocess.Popen(command)
        try:
            demo = Demo(cell)
            episodes = {title: demo.episode(title == "guarded") for title in ("guarded", "unguarded")}
        finally:
            node.terminate()
            node.wait(20.0)
    for title, curves in episodes.items():
        largest_deg = max(abs(value) for _, value in curves[ROTATION])
        print(f"{title}: {len(curves[ROTATION])} estimates, rotation up to {largest_deg:.1f} deg")
    plot(episodes, path)
    print(f"plot: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
