"""The action ~/gripper_cmd: position and effort are requests, the guard's force is the floor."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from action_msgs.msg import GoalStatus
from control_msgs.action import ParallelGripperCommand
from rclpy.action import ActionClient, get_action_names_and_types
from ros_client import RosClient
from rosprocesses import NodeProcess, SimulatedDaemon


class GripperClient:
    """Sends goals and waits for their results."""

    def __init__(self, ros: RosClient) -> None:
        self._client = ActionClient(ros.node, ParallelGripperCommand, "/slipguard/gripper_cmd")
        assert self._client.wait_for_server(30.0)
        self.feedback: list[Any] = []

    def move(self, *positions: float, effort: float | None = None) -> tuple[int, Any]:
        """Return the status and the result of a goal."""
        goal = ParallelGripperCommand.Goal()
        goal.command.name, goal.command.position = ["slipguard_jaws"] * len(positions), list(positions)
        goal.command.effort = [] if effort is None else [effort]
        handle = self._wait(self._client.send_goal_async(goal, self.feedback.append))
        assert handle.accepted
        response = self._wait(handle.get_result_async())
        return response.status, response.result

    def _wait(self, future: Any) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        assert done.wait(30.0)
        return future.result()

    def close(self) -> None:
        self._client.destroy()


@pytest.fixture
def gripper(node: NodeProcess, ros: RosClient) -> Iterator[GripperClient]:
    client = GripperClient(ros)
    yield client
    client.close()


def test_close_on_an_object_and_open_again(daemon: SimulatedDaemon, gripper: GripperClient, ros: RosClient) -> None:
    status, result = gripper.move(0.08)
    assert (status, result.reached_goal, result.stalled) == (GoalStatus.STATUS_SUCCEEDED, True, False)
    assert result.state.position[0] == pytest.approx(0.08, abs=0.002)
    status, result = gripper.move(0.0, effort=50.0)
    assert (status, result.reached_goal, result.stalled) == (GoalStatus.STATUS_SUCCEEDED, False, True)
    assert result.state.effort[0] == pytest.approx(50.0, abs=1.0)
    assert gripper.feedback
    status, _ = gripper.move(0.08)
    assert status == GoalStatus.STATUS_ABORTED, "an object is held: only a release opens"
    assert daemon.state()["gripper"]["holding"]
    assert ros.call("release").success
    daemon.wait_for("idle")


def test_the_guards_force_is_the_floor(daemon: SimulatedDaemon, gripper: GripperClient, ros: RosClient) -> None:
    assert ros.call("grasp").success
    daemon.wait_for("holding")
    width_m = daemon.state()["gripper"]["width_mm"] / 1000.0
    status, result = gripper.move(width_m - 0.01, effort=20.0)
    assert (status, result.stalled) == (GoalStatus.STATUS_SUCCEEDED, True)
    assert result.state.effort[0] == pytest.approx(40.0, abs=1.0), "never loosened"
    status, result = gripper.move(width_m - 0.01, effort=60.0)
    assert status == GoalStatus.STATUS_SUCCEEDED
    assert result.state.effort[0] == pytest.approx(60.0, abs=1.0), "tightened as requested"
    assert daemon.state()["target_force_n"] == pytest.approx(60.0, abs=1.0)


def test_invalid_goals_are_aborted(daemon: SimulatedDaemon, gripper: GripperClient) -> None:
    before_mm = daemon.state()["gripper"]["width_mm"]
    for positions, effort in (((), None), ((0.05, 0.05), None), ((float("nan"),), None), ((0.05,), 500.0)):
        status, _ = gripper.move(*positions, effort=effort)
        assert status == GoalStatus.STATUS_ABORTED
    assert daemon.state()["gripper"]["width_mm"] == pytest.approx(before_mm, abs=1.0), "nothing moved"


def test_an_opening_goal_releases_where_that_is_configured(daemon: SimulatedDaemon, ros: RosClient) -> None:
    with NodeProcess(daemon.socket, "open_releases:=true"):
        gripper = GripperClient(ros)
        assert ros.call("grasp").success
        daemon.wait_for("holding")
        status, result = gripper.move(0.085)
        assert (status, result.reached_goal) == (GoalStatus.STATUS_SUCCEEDED, True)
        daemon.wait_for("idle")
        gripper.close()


def test_moveit_finds_the_action(daemon: SimulatedDaemon, gripper: GripperClient, ros: RosClient) -> None:
    """MoveIt calls the action `/<controller>/<action_ns>`."""
    package = Path(__file__).resolve().parents[1]
    manager = yaml.safe_load((package / "config" / "moveit_controllers.yaml").read_text())[
        "moveit_simple_controller_manager"
    ]
    (name,) = manager["controller_names"]
    entry = manager[name]
    actions = dict(get_action_names_and_types(ros.node))
    assert actions[f"/{name}/{entry['action_ns']}"] == [f"control_msgs/action/{entry['type']}"]
    readme = (package / "README.md").read_text(encoding="utf-8")
    assert all(f"`{action}` of type `{kinds[0]}`" in readme for action, kinds in actions.items())
    assert f"-p joint_name:={entry['joints'][0]} " in readme
