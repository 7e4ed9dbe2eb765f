"""The action ParallelGripperCommand of control_msgs, as MoveIt and other programs use it for a gripper.

The effort is a request: the guard never lowers the force of a held object, and may raise it at any time.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from typing import Any

from control_msgs.action import ParallelGripperCommand
from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.lifecycle import Node

from slipguard_ros.local_api import DaemonUnreachable, LocalApi, RequestRefused
from slipguard_ros.messages import Stamps, joint_message
from slipguard_ros.readings import JawJoint

POLL_S = 0.05
MOTION_TIMEOUT_S = 10.0
TOLERANCE_MM = 2.0
SAME_GRIP_S = 0.2
"""A grip that is seen for this long after the command is the result of it."""


class GripperAction:
    """Serves `~/gripper_cmd`.

    Args:
        joint: Converts the goal's position to a width.
        open_releases: An opening goal releases a held object; otherwise it is aborted.
        inactive: Returns why no goal is accepted now; None if goals are accepted.
    """

    def __init__(
        self,
        node: Node,
        api: LocalApi,
        stamps: Stamps,
        joint: JawJoint,
        open_releases: bool,
        inactive: Callable[[], str | None],
    ) -> None:
        self._api, self._stamps, self._joint = api, stamps, joint
        self._open_releases, self._inactive = open_releases, inactive
        self._log = node.get_logger()
        self._newest: ServerGoalHandle | None = None
        self._lock = threading.Lock()
        self._server = ActionServer(
            node, ParallelGripperCommand, "~/gripper_cmd", self._execute, callback_group=ReentrantCallbackGroup()
        )

    def destroy(self) -> None:
        """End the server; a goal that is executed is aborted."""
        with self._lock:
            self._newest = None
        self._server.destroy()

    def _execute(self, goal: ServerGoalHandle) -> ParallelGripperCommand.Result:
        with self._lock:
            self._newest = goal
        result = ParallelGripperCommand.Result()
        try:
            self._move(goal, result)
            goal.succeed()
        except (RequestRefused, DaemonUnreachable) as why:
            self._log.warning(f"gripper command aborted: {why}")
            goal.abort()
        return result

    def _move(self, goal: ServerGoalHandle, result: ParallelGripperCommand.Result) -> None:
        """Send the goal's command and wait for its end. Raises RequestRefused if it is not reached."""
        why = self._inactive()
        if why is not None:
            raise RequestRefused(why)
        width_mm, force_n = self._wanted(goal.request.command)
        gripper = self._fill(result, self._gripper())
        if gripper["holding"] and width_mm > gripper["width_mm"] + TOLERANCE_MM:
            if not self._open_releases:
                reason = "an object is held and would drop; support it, then call ~/release, or set open_releases"
                raise RequestRefused(reason)
            self._api.submit("release", {"confirm": True, "width_mm": width_mm})
        else:
            fields = {"width_mm": width_mm} | ({} if force_n is None else {"force_n": force_n})
            self._api.submit("gripper", fields)
        self._wait(goal, result, width_mm)

    def _wait(self, goal: ServerGoalHandle, result: ParallelGripperCommand.Result, width_mm: float) -> None:
        commanded_s = time.monotonic()
        while time.monotonic() - commanded_s < MOTION_TIMEOUT_S:
            time.sleep(POLL_S)
            if self._newest is not goal:
                raise RequestRefused("replaced by a newer goal")
            gripper = self._fill(result, self._gripper())
            goal.publish_feedback(ParallelGripperCommand.Feedback(state=result.state))
            result.reached_goal = abs(gripper["width_mm"] - width_mm) <= TOLERANCE_MM
            result.stalled = bool(gripper["holding"])
            settled = gripper["measured_at_s"] > commanded_s + SAME_GRIP_S and not gripper["moving"]
            if settled and (result.reached_goal or result.stalled):
                return
        raise RequestRefused(f"neither the position nor an object was reached within {MOTION_TIMEOUT_S:g} s")

    def _wanted(self, command: Any) -> tuple[float, float | None]:
        """Return width and force of a goal; None for the configured force."""
        if len(command.position) != 1 or not math.isfinite(command.position[0]):
            raise RequestRefused(
                f"the goal has the positions {list(command.position)}; give one, of {self._joint.name}"
            )
        force_n = command.effort[0] if len(command.effort) else 0.0
        return max(self._joint.width_mm(command.position[0]), 0.0), force_n if force_n > 0.0 else None

    def _gripper(self) -> dict[str, Any]:
        """Return the gripper's state. Raises RequestRefused during a fault, or if the gripper does not respond."""
        state = self._api.state()
        fault, gripper = state["fault"], state["gripper"]
        if fault or not gripper:
            raise RequestRefused(f"fault {fault['code']}: {fault['observed']}" if fault else "the gripper is silent")
        return dict(gripper)

    def _fill(self, result: ParallelGripperCommand.Result, gripper: dict[str, Any]) -> dict[str, Any]:
        result.state = joint_message(gripper, self._joint, self._stamps.header(gripper["measured_at_s"], "grasp"))
        return gripper
