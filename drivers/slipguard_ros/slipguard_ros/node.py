"""The lifecycle node `slipguard`: topics, services and the gripper action of one daemon.

The daemon may start, stop and restart at any time: the node connects again, and `/diagnostics` shows the loss.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable
from functools import partial
from typing import Any

import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import PoseWithCovarianceStamped, WrenchStamped
from rclpy._rclpy_pybind11 import RCLError  # public under no other name
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import ExternalShutdownException, MultiThreadedExecutor
from rclpy.lifecycle import LifecycleState, Node, TransitionCallbackReturn
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import Image, JointState
from std_msgs.msg import String
from std_srvs.srv import SetBool, Trigger

from slipguard_ros import messages as m
from slipguard_ros.local_api import DaemonUnreachable, LocalApi, RequestRefused, StreamThread
from slipguard_ros.readings import JawJoint, device_statuses, parse_frame, rotation_of, unreachable_status

try:
    from slipguard_ros.gripper_action import GripperAction
except ImportError:  # control_msgs is optional
    GripperAction = None  # type: ignore[assignment, misc]

FINGERS = ("left", "right")
SERVICES: dict[str, dict[str, Any]] = {
    "grasp": {},
    "lift": {},
    "lower": {},
    "stop": {},
    "release": {"confirm": True},
    "clear": {},
    "calibrate": {},
}
"""Services of type Trigger, and the fields of their requests."""
CALIBRATE_TIMEOUT_S = 35.0
QUEUE = 10
THREADS = 16
"""More than can be blocked at a time, by one call of each service and by goals of the action: `stop` never waits."""
DIAGNOSTICS_PERIOD_S = 1.0
PARAMETERS: dict[str, Any] = {
    "socket": "",
    "autostart": True,
    "frame_prefix": "slipguard_",
    "joint_name": "slipguard_jaws",
    "joint_scale": 1.0,
    "joint_offset": 0.0,
    "open_releases": False,
}


class SlipguardNode(Node):
    """inactive: services refuse, nothing is published. active: everything works."""

    def __init__(self) -> None:
        super().__init__("slipguard")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        self._active = False
        self._streams: list[StreamThread] = []
        self._state: dict[str, Any] | None = None
        self._lost = "no state has been received yet"
        self._logged_event_s = 0.0
        self._action: Any = None
        self._owned: list[tuple[Callable[[Any], bool], Any]] = []

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create publishers, services and the action from the parameters."""
        value = {name: self.get_parameter(name).value for name in PARAMETERS}
        if value["joint_scale"] == 0.0:
            self.get_logger().error("joint_scale is 0; it must be the joint's change per meter between the jaws")
            return TransitionCallbackReturn.FAILURE
        self._api = LocalApi(value["socket"])
        self._joint = JawJoint(value["joint_name"], value["joint_scale"], value["joint_offset"])
        self._stamps = m.Stamps(self.get_clock(), value["frame_prefix"])
        self._states = self._publisher(String, "~/state", QUEUE)
        self._rotations = self._publisher(PoseWithCovarianceStamped, "~/rotation", QUEUE)
        self._forces = self._publisher(WrenchStamped, "~/grip_force", QUEUE)
        self._joints = self._publisher(JointState, "~/joint_states", QUEUE)
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics", QUEUE)
        self._images = {
            finger: self._publisher(Image, f"~/{finger}/image_raw", qos_profile_sensor_data) for finger in FINGERS
        }
        for name, fields in SERVICES.items():
            self._service(Trigger, name, partial(self._trigger, name, fields))
        self._service(SetBool, "guard", self._guard)
        timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics)
        self._owned.append((self.destroy_timer, timer))
        if GripperAction is None:
            self.get_logger().info("control_msgs is not installed: the action ~/gripper_cmd is not offered")
        else:
            self._action = GripperAction(
                self, self._api, self._stamps, self._joint, value["open_releases"], self._inactive
            )
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to receive and to publish."""
        result = super().on_activate(state)
        self._active, self._logged_event_s = True, time.monotonic()
        self._streams = [
            StreamThread(self._api, "/live", self._on_live, self._on_lost),
            *(
                StreamThread(self._api, f"/frames/{finger}", partial(self._on_frame, finger), self._on_frames_lost)
                for finger in FINGERS
            ),
        ]
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop to publish; the daemon goes on guarding."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy what `on_configure` created."""
        self._stop()
        if self._action is not None:
            self._action.destroy()
            self._action = None
        for destroy, entity in self._owned:
            destroy(entity)
        self._owned.clear()
        return TransitionCallbackReturn.SUCCESS

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """The same, from any state."""
        return self.on_cleanup(state)

    def _stop(self) -> None:
        self._active = False
        for stream in self._streams:
            stream.stop()
        self._streams = []
        self._state, self._lost = None, "the node is not active"

    def _publisher(self, kind: Any, topic: str, qos: Any) -> Any:
        made = self.create_lifecycle_publisher(kind, topic, qos)
        self._owned.append((self.destroy_lifecycle_publisher, made))
        return made

    def _service(self, kind: Any, name: str, handle: Callable[[Any, Any], Any]) -> None:
        made = self.create_service(kind, f"~/{name}", handle, callback_group=MutuallyExclusiveCallbackGroup())
        self._owned.append((self.destroy_service, made))

    def _inactive(self) -> str | None:
        return None if self._active else "the node is not active; activate it"

    def _trigger(self, name: str, fields: dict[str, Any], call: Any, response: Any) -> Any:
        return self._submit(name, fields, response)

    def _guard(self, call: Any, response: Any) -> Any:
        return self._submit("guard", {"on": call.data}, response)

    def _submit(self, name: str, fields: dict[str, Any], response: Any) -> Any:
        """Send a request to the daemon and fill the service's response."""
        try:
            why = self._inactive()
            if why is not None:
                raise RequestRefused(why)
            timeout_s = CALIBRATE_TIMEOUT_S if name == "calibrate" else 6.0
            response.message, response.success = self._api.submit(name, fields, timeout_s), True
        except (RequestRefused, DaemonUnreachable) as error:
            response.message, response.success = str(error), False
        return response

    def _on_lost(self, why: str) -> None:
        if self.context.ok() and (self._state is not None or why != self._lost):
            self.get_logger().warning(f"no state from the daemon: {why}")
        self._state, self._lost = None, why

    def _on_frames_lost(self, why: str) -> None:
        if self.context.ok():
            self.get_logger().debug(f"no frames from the daemon: {why}")

    def _on_live(self, raw: bytearray) -> None:
        message = json.loads(raw)
        if message["type"] == "event":
            self._log_event(message["event"])
        elif message["type"] == "state" and self._active:
            self._publish_state(message["state"])

    def _publish_state(self, state: dict[str, Any]) -> None:
        self._state = state
        self._states.publish(m.state_message(state))
        rotation, gripper = rotation_of(state), state.get("gripper")
        if rotation is not None:
            self._rotations.publish(m.rotation_message(rotation, self._stamps.header(state["now_s"], "grasp")))
        if gripper is not None:
            header = self._stamps.header(gripper["measured_at_s"], "grasp")
            self._joints.publish(m.joint_message(gripper, self._joint, header))
            self._forces.publish(m.force_message(gripper, header))

    def _log_event(self, event: dict[str, Any]) -> None:
        """Log each event once; the stream begins with old ones."""
        if event["at_s"] > self._logged_event_s:
            self._logged_event_s = event["at_s"]
            text, log = ". ".join(part for part in (event["text"], event.get("what_to_do")) if part), self.get_logger()
            if event["level"] == "fault":  # a line each: rclpy allows one severity per line
                log.error(text)
            elif event["level"] == "warning":
                log.warning(text)
            else:
                log.info(text)

    def _on_frame(self, finger: str, raw: bytearray) -> None:
        if self._active:
            image = parse_frame(raw)
            header = self._stamps.header(image.captured_at_s, finger)
            self._images[finger].publish(m.image_message(image, header))

    def _publish_diagnostics(self) -> None:
        if self._active:
            state = self._state
            statuses = unreachable_status(self._lost) if state is None else device_statuses(state)
            self._diagnostics.publish(m.diagnostics_message(statuses, self._stamps.header(None, "")))


def main() -> None:
    """Run the node until it is shut down."""
    rclpy.init()
    node = SlipguardNode()
    executor = MultiThreadedExecutor(num_threads=THREADS)
    executor.add_node(node)
    try:
        if node.get_parameter("autostart").value:
            node.trigger_configure()
            node.trigger_activate()
        executor.spin()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RCLError:
        if rclpy.ok():  # else: shut down while the executor was about to wait
            raise
    finally:
        node._stop()
        rclpy.try_shutdown()


if __name__ == "__main__":
    main()
