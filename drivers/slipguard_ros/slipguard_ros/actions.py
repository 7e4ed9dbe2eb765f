"""The actions: a goal sends a request to the daemon, then follows the daemon's state until the motion has ended."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.action import ActionServer, CancelResponse
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import Node

from slipguard_client import DaemonUnreachable, LocalApi, RequestRefused
from slipguard_ros.messages import JawJoint, Stamps, fill, joint_message, state_values

POLL_S = 0.05
JAWS_TIMEOUT_S = 10.0
CANCEL_TIMEOUT_S = 1.0
TOLERANCE_MM = 2.0
SAME_GRIP_S = 0.2
"""A grip that is seen for this long after the command is the result of it."""


@dataclass(frozen=True)
class ActionContext:
    """What the actions of a node share.

    Args:
        inactive: Returns why no goal is accepted now; None if goals are accepted.
        open_releases: An opening goal of the gripper releases a held object; otherwise it is aborted.
    """

    node: Node
    api: LocalApi
    stamps: Stamps
    joint: JawJoint
    open_releases: bool
    inactive: Callable[[], str | None]


class MotionAction:
    """One action server.

    kind: the action's type. start: sends the request of a goal. follow: fills a message from the state, and returns
    whether the motion has ended; it raises RequestRefused if the goal cannot be reached any more.
    """

    def __init__(self, context: ActionContext, name: str, kind: Any) -> None:
        self.context, self.kind = context, kind
        self._newest: ServerGoalHandle | None = None
        self._cancelled: ServerGoalHandle | None = None
        self._lock = threading.Lock()
        self._server = ActionServer(
            context.node,
            kind,
            name,
            self._execute,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=self._cancel,
        )

    def destroy(self) -> None:
        """End the server; a goal that is executed is aborted."""
        with self._lock:
            self._newest = None
        self._server.destroy()

    def start(self, request: Any) -> None:
        raise NotImplementedError

    def follow(self, request: Any, state: dict[str, Any], since_s: float, message: Any) -> bool:
        raise NotImplementedError

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        """Stop the arm at once; the grip stays guarded."""
        self._cancelled = goal
        try:
            self.context.api.submit("stop")
        except (RequestRefused, DaemonUnreachable) as why:
            self.context.node.get_logger().error(f"the arm was not stopped: {why}")
            return CancelResponse.REJECT
        return CancelResponse.ACCEPT

    def _execute(self, goal: ServerGoalHandle) -> Any:
        with self._lock:
            self._newest = goal
        result = self.kind.Result()
        try:
            why = self.context.inactive()
            if why is not None:
                raise RequestRefused(why)
            self.start(goal.request)
            self._wait(goal, result)
        except (RequestRefused, DaemonUnreachable) as why:
            if self._cancelled is goal and self._is_cancelling(goal):
                goal.canceled()
            else:
                goal.abort()
                self.context.node.get_logger().warning(f"goal aborted: {why}")
            if hasattr(result, "message"):
                result.message = str(why)
        else:
            goal.succeed()
        return result

    def _is_cancelling(self, goal: ServerGoalHandle) -> bool:
        """Return whether rclpy has recorded the cancel: it does so shortly after `_cancel`."""
        ends_s = time.monotonic() + CANCEL_TIMEOUT_S
        while not goal.is_cancel_requested and time.monotonic() < ends_s:
            time.sleep(POLL_S)
        return bool(goal.is_cancel_requested)

    def _wait(self, goal: ServerGoalHandle, result: Any) -> None:
        since_s = time.monotonic()
        ended = False
        while not ended:
            time.sleep(POLL_S)
            if self._newest is not goal:
                raise RequestRefused("replaced by a newer goal")
            state = self.context.api.state()
            if (state["now_s"] or 0.0) <= since_s:
                continue  # from before the request
            self.follow(goal.request, state, since_s, result)
            feedback = self.kind.Feedback()
            ended = self.follow(goal.request, state, since_s, feedback)
            goal.publish_feedback(feedback)


class GraspAction(MotionAction):
    """`~/grasp_object`: close on the object, until it is held and guarded."""

    moving = ("closing", "reference")

    def start(self, request: Any) -> None:
        self.context.api.submit("grasp", request_fields(request))

    def follow(self, request: Any, state: dict[str, Any], since_s: float, message: Any) -> bool:
        fill(message, state_values(state, self.context.stamps))
        fault, phase = state["fault"], state["phase"]
        if fault:
            raise RequestRefused(f"{fault['code']}: {fault['observed']}. {fault['what_to_do']}")
        if phase in self.moving:
            return False
        if state["stopped_by_request"]:
            raise RequestRefused("stopped by request")
        if phase != "holding":
            raise RequestRefused(f"nothing is held (phase {phase})")
        return True


class LiftAction(GraspAction):
    """`~/lift_object`: lift or lower the held object, until the arm has arrived."""

    moving = ("lifting", "lowering")

    def start(self, request: Any) -> None:
        fields = request_fields(request)
        kind = "lower" if request.height < 0.0 else "lift"
        self.context.api.submit(kind, fields | ({"height_mm": abs(fields["height_mm"])} if request.height else {}))


class GripperAction(MotionAction):
    """`~/gripper_cmd`, as MoveIt uses it. The effort is a request: the guard never lowers the force of a held grip."""

    def _cancel(self, goal: ServerGoalHandle) -> CancelResponse:
        return CancelResponse.REJECT  # jaws that close continue until they hold

    def start(self, request: Any) -> None:
        api, width_mm, force_n = self.context.api, *self._wanted(request.command)
        gripper = api.state()["gripper"]
        if gripper and gripper["holding"] and width_mm > gripper["width_mm"] + TOLERANCE_MM:
            if not self.context.open_releases:
                reason = "an object is held and would drop; support it, then call ~/release, or set open_releases"
                raise RequestRefused(reason)
            api.submit("release", {"confirm": True, "width_mm": width_mm})
        else:
            api.submit("gripper", {"width_mm": width_mm, "force_n": force_n})

    def follow(self, request: Any, state: dict[str, Any], since_s: float, message: Any) -> bool:
        fault, gripper, (width_mm, _) = state["fault"], state["gripper"], self._wanted(request.command)
        if fault or not gripper:
            raise RequestRefused(f"{fault['code']}: {fault['observed']}" if fault else "the gripper does not respond")
        header = self.context.stamps.header(gripper["measured_at_s"], "grasp")
        message.state = joint_message(gripper, self.context.joint, header)
        reached, stalled = abs(gripper["width_mm"] - width_mm) <= TOLERANCE_MM, bool(gripper["holding"])
        if hasattr(message, "reached_goal"):
            message.reached_goal, message.stalled = reached, stalled
        if time.monotonic() - since_s > JAWS_TIMEOUT_S:
            raise RequestRefused(f"neither the position nor an object was reached within {JAWS_TIMEOUT_S:g} s")
        settled = gripper["measured_at_s"] > since_s + SAME_GRIP_S and not gripper["moving"]
        return settled and (reached or stalled)

    def _wanted(self, command: Any) -> tuple[float, float | None]:
        """Return width and force of a goal; None for the configured force."""
        joint, positions = self.context.joint, list(command.position)
        if len(positions) != 1 or not math.isfinite(positions[0]):
            raise RequestRefused(f"the goal has the positions {positions}; give one, of {joint.name}")
        force_n = command.effort[0] if len(command.effort) else 0.0
        return max(joint.width_mm(positions[0]), 0.0), force_n if force_n > 0.0 else None


REQUEST_UNITS = {
    "force": ("force_n", 1.0),
    "force_limit": ("force_limit_n", 1.0),
    "height": ("height_mm", 1e3),
    "speed": ("speed_mm_s", 1e3),
}
"""Fields of services and goals: the daemon's name, and the factor from SI units."""


def request_fields(request: Any) -> dict[str, Any]:
    """Return the daemon's fields of a service's request or a goal; a number that is 0 is left out: as configured."""
    fields: dict[str, Any] = {}
    for name, kind in request.get_fields_and_field_types().items():
        value = getattr(request, name)
        if kind == "boolean":
            fields[name] = value
        elif value != 0.0:
            key, factor = REQUEST_UNITS[name]
            fields[key] = factor * value
    return fields
