"""The lifecycle node `slipguard`: topics, services and actions of one daemon.

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

from slipguard_client import FINGERS, DaemonUnreachable, LocalApi, RequestRefused, StreamThread, parse_frame
from slipguard_ros import interfaces
from slipguard_ros import messages as m
from slipguard_ros.actions import ActionContext, GraspAction, GripperAction, LiftAction, MotionAction, request_fields

try:
    from control_msgs.action import ParallelGripperCommand
except ImportError:  # optional
    ParallelGripperCommand = None
REQUESTS: dict[str, tuple[str, dict[str, Any]]] = {
    "activate_gripper": ("activate", {}),
    "release": ("release", {"confirm": True}),
}
"""The daemon's request and its fixed fields, where they are not the service's."""
QUEUE = 10
THREADS = 16
"""More than can be blocked at a time, by one call of each service and by goals of the actions: `stop` never waits."""
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
    """inactive: services and actions refuse, nothing is published. active: everything works."""

    def __init__(self) -> None:
        super().__init__("slipguard")
        for name, default in PARAMETERS.items():
            self.declare_parameter(name, default)
        self._active = False
        self._streams: list[StreamThread] = []
        self._state: dict[str, Any] | None = None
        self._lost = "no state has been received yet"
        self._logged_event_s = 0.0
        self._actions: list[MotionAction] = []
        self._owned: list[tuple[Callable[[Any], bool], Any]] = []

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Create publishers, services and actions from the parameters."""
        value = {name: self.get_parameter(name).value for name in PARAMETERS}
        if value["joint_scale"] == 0.0:
            self.get_logger().error("joint_scale is 0; it must be the joint's change per meter between the jaws")
            return TransitionCallbackReturn.FAILURE
        self._api = LocalApi(value["socket"])
        self._joint = m.JawJoint(value["joint_name"], value["joint_scale"], value["joint_offset"])
        self._stamps = m.Stamps(self.get_clock(), value["frame_prefix"])
        self._states = self._publisher(interfaces.typed_messages.State if interfaces.TYPED else String, "~/state")
        self._slips = self._publisher(interfaces.typed_messages.SlipEstimate, "~/slip") if interfaces.TYPED else None
        self._rotations = self._publisher(PoseWithCovarianceStamped, "~/rotation")
        self._forces = self._publisher(WrenchStamped, "~/grip_force")
        self._joints = self._publisher(JointState, "~/joint_states")
        self._diagnostics = self._publisher(DiagnosticArray, "/diagnostics")
        self._images = {
            finger: self._publisher(Image, f"~/{finger}/image_raw", qos_profile_sensor_data) for finger in FINGERS
        }
        for name, kind in interfaces.SERVICES.items():
            group = MutuallyExclusiveCallbackGroup()
            service = self.create_service(kind, f"~/{name}", partial(self._respond, name), callback_group=group)
            self._owned.append((self.destroy_service, service))
        timer = self.create_timer(DIAGNOSTICS_PERIOD_S, self._publish_diagnostics)
        self._owned.append((self.destroy_timer, timer))
        context = ActionContext(self, self._api, self._stamps, self._joint, value["open_releases"], self._inactive)
        if interfaces.TYPED:
            self._actions.append(GraspAction(context, "~/grasp_object", interfaces.typed_actions.Grasp))
            self._actions.append(LiftAction(context, "~/lift_object", interfaces.typed_actions.Lift))
        else:
            self.get_logger().warning(interfaces.WITHOUT_TYPES)
        if ParallelGripperCommand is not None:
            self._actions.append(GripperAction(context, "~/gripper_cmd", ParallelGripperCommand))
        else:
            self.get_logger().info("control_msgs is not installed: the action ~/gripper_cmd is not offered")
        return TransitionCallbackReturn.SUCCESS

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Start to receive and to publish."""
        result = super().on_activate(state)
        self._active, self._logged_event_s = True, time.monotonic()
        streams = {"/live": self._on_live, "/estimates": self._on_estimates}
        streams |= {f"/frames/{finger}": partial(self._on_frame, finger) for finger in FINGERS}
        self._streams = [
            StreamThread(self._api, path, on_message, self._on_lost if path == "/live" else self._on_stream_lost)
            for path, on_message in streams.items()
        ]
        return result

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop to publish; the daemon goes on guarding."""
        self._stop()
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Destroy what `on_configure` created."""
        self._stop()
        for action in self._actions:
            action.destroy()
        for destroy, entity in self._owned:
            destroy(entity)
        self._actions.clear()
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

    def _publisher(self, kind: Any, topic: str, qos: Any = QUEUE) -> Any:
        made = self.create_lifecycle_publisher(kind, topic, qos)
        self._owned.append((self.destroy_lifecycle_publisher, made))
        return made

    def _inactive(self) -> str | None:
        return None if self._active else "the node is not active; activate it"

    def _respond(self, name: str, call: Any, response: Any) -> Any:
        """Send the request of a service to the daemon and fill the service's response."""
        kind, fixed = REQUESTS.get(name, (name, {}))
        fields = {"on": call.data} if name == "guard" else {**fixed, **request_fields(call)}
        try:
            why = self._inactive()
            if why is not None:
                raise RequestRefused(why)
            response.message, response.success = self._api.submit(kind, fields), True
        except (RequestRefused, DaemonUnreachable) as error:
            response.message, response.success = str(error), False
        return response

    def _on_lost(self, why: str) -> None:
        if self.context.ok() and (self._state is not None or why != self._lost):
            self.get_logger().warning(f"no state from the daemon: {why}")
        self._state, self._lost = None, why

    def _on_stream_lost(self, why: str) -> None:
        if self.context.ok():
            self.get_logger().debug(f"no frames or estimates from the daemon: {why}")

    def _on_live(self, raw: bytearray) -> None:
        message = json.loads(raw)
        if message["type"] == "event":
            self._log_event(message["event"])
        elif message["type"] == "state" and self._active:
            self._publish_state(message["state"])

    def _publish_state(self, state: dict[str, Any]) -> None:
        self._state, gripper = state, state["gripper"]
        if interfaces.TYPED:
            self._states.publish(m.fill(interfaces.typed_messages.State(), m.state_values(state, self._stamps)))
        else:
            self._states.publish(String(data=json.dumps(state)))
        if gripper is not None:
            header = self._stamps.header(gripper["measured_at_s"], "grasp")
            self._joints.publish(m.joint_message(gripper, self._joint, header))
            self._forces.publish(m.force_message(gripper, header))

    def _on_estimates(self, raw: bytearray) -> None:
        """Publish what one control cycle measured; the rotation only if there is one."""
        if not self._active:
            return
        message = json.loads(raw)
        rotation = message["rotation"]
        header = self._stamps.header(rotation["captured_at_s"] if rotation else message["at_s"], "grasp")
        if self._slips is not None:
            values = m.slip_values(rotation, header, message["number"])
            self._slips.publish(m.fill(interfaces.typed_messages.SlipEstimate(), values))
        if rotation and rotation["rotation_deg"] is not None:
            self._rotations.publish(m.rotation_message(rotation, header))

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
            self._diagnostics.publish(m.diagnostics_message(self._state, self._lost, self._stamps.now()))


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
