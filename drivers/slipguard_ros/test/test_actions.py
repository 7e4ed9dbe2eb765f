"""The actions: feedback, results, cancelling; and for the gripper: the guard's force is the floor."""

from __future__ import annotations

import math
import time
from typing import Any

import pytest
from action_msgs.msg import GoalStatus
from control_msgs.action import ParallelGripperCommand
from daemon_processes import Daemon, wait_until
from ros_client import Goals, NodeProcess, RosClient

from slipguard_ros_interfaces.action import Grasp, Lift

SUCCEEDED, ABORTED, CANCELED = (
    GoalStatus.STATUS_SUCCEEDED,
    GoalStatus.STATUS_ABORTED,
    GoalStatus.STATUS_CANCELED,
)


def test_grasp_and_lift_report_what_happens(daemon: Daemon, node: NodeProcess, ros: RosClient) -> None:
    grasp, lift = Goals(ros, Grasp, "grasp_object"), Goals(ros, Lift, "lift_object")
    wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
    status, result = lift.run(Lift.Goal())
    assert (status, "cannot lift" in result.message) == (ABORTED, True), "nothing is held"
    status, result = grasp.run(Grasp.Goal(force=45.0))
    assert (status, result.message, result.force) == (SUCCEEDED, "", pytest.approx(45.0, abs=1.0))
    assert result.width == pytest.approx(daemon.state()["gripper"]["width_mm"] / 1000.0, abs=0.001)
    assert {"closing"} <= {one.phase for one in grasp.feedback}
    status, result = lift.run(Lift.Goal(height=0.03, speed=0.02))
    assert (status, result.message) == (SUCCEEDED, "")
    assert result.lifted == pytest.approx(0.03, abs=0.002)
    assert result.slip.valid
    assert result.slip.rotation == pytest.approx(math.radians(daemon.state()["rotation"]["rotation_deg"]), abs=0.02)
    lifted = [one.lifted for one in lift.feedback if one.phase == "lifting"]
    assert max(lifted) > 0.02 > min(lifted)
    status, result = lift.run(Lift.Goal(height=-0.01))
    assert status == SUCCEEDED
    assert result.lifted == pytest.approx(0.02, abs=0.002)


def test_cancelling_a_lift_stops_the_arm_and_keeps_the_grip(daemon: Daemon, node: NodeProcess, ros: RosClient) -> None:
    daemon.grasp(force_n=100.0)
    lift = Goals(ros, Lift, "lift_object")
    wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
    handle = lift.send(Lift.Goal(height=0.15, speed=0.02))
    wait_until(lambda: (daemon.state()["lifted_mm"] or 0.0) > 10.0, "the arm lifts")
    called_s = time.monotonic()
    response = ros.result(handle.cancel_goal_async())
    assert len(response.goals_canceling) == 1
    wait_until(lambda: not daemon.state()["arm"]["moving"], "the arm stands")
    print(
        f"{1e3 * (time.monotonic() - called_s):.0f} ms until the state, read ten times per second, shows a resting arm"
    )
    assert ros.result(handle.get_result_async()).status == CANCELED
    before_mm = daemon.state()["lifted_mm"]
    time.sleep(0.5)
    state = daemon.state()
    assert state["lifted_mm"] == pytest.approx(before_mm, abs=0.1)
    assert state["lifted_mm"] < 100.0
    assert (state["phase"], state["gripper"]["holding"], state["guarding"]) == ("holding", True, True)
    status, _ = lift.run(Lift.Goal(height=0.005))
    assert status == SUCCEEDED, "the next goal moves again"


def test_a_goal_that_another_client_stops_is_aborted(daemon: Daemon, node: NodeProcess, ros: RosClient) -> None:
    daemon.grasp(force_n=100.0)
    lift = Goals(ros, Lift, "lift_object")
    wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
    handle = lift.send(Lift.Goal(height=0.15, speed=0.02))
    wait_until(lambda: daemon.state()["phase"] == "lifting", "the arm lifts")
    assert ros.call("stop").success
    done = ros.result(handle.get_result_async())
    assert (done.status, done.result.message) == (ABORTED, "stopped by request")


@pytest.fixture
def gripper(node: NodeProcess, ros: RosClient) -> Goals:
    goals = Goals(ros, ParallelGripperCommand, "gripper_cmd")
    wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
    return goals


def move(*positions: float, effort: float | None = None) -> Any:
    goal = ParallelGripperCommand.Goal()
    goal.command.name, goal.command.position = ["slipguard_jaws"] * len(positions), list(positions)
    goal.command.effort = [] if effort is None else [effort]
    return goal


def test_the_gripper_closes_on_an_object_and_opens_only_by_release(
    daemon: Daemon, gripper: Goals, ros: RosClient
) -> None:
    status, result = gripper.run(move(0.08))
    assert (status, result.reached_goal, result.stalled) == (SUCCEEDED, True, False)
    assert result.state.position[0] == pytest.approx(0.08, abs=0.002)
    status, result = gripper.run(move(0.0, effort=50.0))
    assert (status, result.reached_goal, result.stalled) == (SUCCEEDED, False, True)
    assert result.state.effort[0] == pytest.approx(50.0, abs=1.0)
    assert gripper.feedback
    status, _ = gripper.run(move(0.0, effort=20.0))
    assert daemon.state()["gripper"]["force_n"] == pytest.approx(50.0, abs=1.0), "never loosened"
    status, result = gripper.run(move(0.0, effort=60.0))
    assert (status, result.state.effort[0]) == (SUCCEEDED, pytest.approx(60.0, abs=1.0)), "tightened as requested"
    status, _ = gripper.run(move(0.08))
    assert status == ABORTED, "an object is held: only a release opens"
    assert ros.call("release").success
    daemon.wait_for("idle")


def test_invalid_gripper_goals_are_aborted(daemon: Daemon, gripper: Goals) -> None:
    before_mm = daemon.state()["gripper"]["width_mm"]
    for positions, effort in (((), None), ((0.05, 0.05), None), ((math.nan,), None), ((0.05,), 500.0)):
        status, _ = gripper.run(move(*positions, effort=effort))
        assert status == ABORTED
    assert daemon.state()["gripper"]["width_mm"] == pytest.approx(before_mm, abs=1.0), "nothing moved"


def test_an_opening_goal_releases_where_that_is_configured(daemon: Daemon, ros: RosClient) -> None:
    with NodeProcess(daemon.socket, "open_releases:=true"):
        gripper = Goals(ros, ParallelGripperCommand, "gripper_cmd")
        daemon.grasp()
        wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
        status, result = gripper.run(move(0.085))
        assert (status, result.reached_goal) == (SUCCEEDED, True)
        daemon.wait_for("idle")
