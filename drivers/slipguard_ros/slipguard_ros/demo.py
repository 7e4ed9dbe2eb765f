"""Grasp and lift in a simulated cell through ROS, with and without the guard: `slipguard_ros_demo SLIPGUARD PLOT`."""

from __future__ import annotations

import math
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import rclpy
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy.executors import SingleThreadedExecutor
from slipguard_demo import EmulatedCell, plot, wait_until
from std_srvs.srv import SetBool

from slipguard_ros.interfaces import call

LIFT_TIMEOUT_S = 60.0
AFTER_S = 1.0


class Listener:
    """Receives rotation and grip force. rotations, forces: time of capture in seconds, and degrees or newtons."""

    def __init__(self) -> None:
        self.node = rclpy.create_node("slipguard_demo")
        self.rotations: list[tuple[float, float]] = []
        self.forces: list[tuple[float, float]] = []
        self.node.create_subscription(PoseWithCovarianceStamped, "/slipguard/rotation", self._on_rotation, 10)
        self.node.create_subscription(WrenchStamped, "/slipguard/grip_force", self._on_force, 10)
        executor = SingleThreadedExecutor()
        executor.add_node(self.node)
        threading.Thread(target=executor.spin, daemon=True).start()

    def _on_rotation(self, message: PoseWithCovarianceStamped) -> None:
        orientation = message.pose.pose.orientation
        rotation_deg = math.degrees(2.0 * math.atan2(orientation.z, orientation.w))
        self.rotations.append((_time_s(message), rotation_deg))

    def _on_force(self, message: WrenchStamped) -> None:
        self.forces.append((_time_s(message), message.wrench.force.z))

    def start(self) -> None:
        """Forget what was received."""
        self.rotations, self.forces = [], []

    def curves(self) -> dict[str, list[tuple[float, float]]]:
        """Return what was received since `start`, in seconds since the first rotation, by time of capture."""
        wait_until(lambda: self.rotations, "an estimate")
        zero_s = min(self.rotations)[0]
        return {
            label: [(at_s - zero_s, value) for at_s, value in sorted(values) if at_s >= zero_s]
            for label, values in (("rotation [deg]", self.rotations), ("grip force [N]", self.forces))
        }


def _time_s(message: Any) -> float:
    return float(message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec)


def lift(cell: EmulatedCell, listener: Listener, client: Any, guarded: bool) -> dict[str, list[tuple[float, float]]]:
    """Grasp and lift the object; return the curves of this episode."""
    _request(client, "grasp")
    listener.start()
    cell.wait_for("holding")
    _request(client, "guard", SetBool.Request(data=guarded))
    _request(client, "lift")
    wait_until(lambda: cell.state()["phase"] in ("holding", "fault"), "the end of the lift", LIFT_TIMEOUT_S)
    time.sleep(AFTER_S)
    curves = listener.curves()
    cell.release()
    return curves


def _request(client: Any, service: str, request: Any = None) -> None:
    """Call a service until it accepts: the node may not be active yet, the grip not firm yet. Raises AssertionError."""
    reasons: list[str] = []

    def accepted() -> bool:
        response = call(client, service, request)
        reasons.append(f"no service {service}" if response is None else response.message)
        return response is not None and response.success

    try:
        wait_until(accepted, service)
    except AssertionError:
        raise AssertionError(f"{service}: {reasons[-1] if reasons else 'no response'}") from None


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
            listener, client = Listener(), rclpy.create_node("slipguard_demo_client")
            episodes = {}
            for title, guarded in (("guarded", True), ("unguarded", False)):
                curves = lift(cell, listener, client, guarded)
                episodes[title] = curves
                largest_deg = max(abs(value) for _, value in curves["rotation [deg]"])
                print(f"{title}: {len(curves['rotation [deg]'])} estimates, rotation up to {largest_deg:.1f} deg")
        finally:
            node.terminate()
            node.wait(20.0)
    plot(episodes, path)
    print(f"plot: {path}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
