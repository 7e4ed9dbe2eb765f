"""README, launch file, parameter file and the entries for RViz and MoveIt name what the node really offers."""

from __future__ import annotations

import contextlib
import importlib.metadata
import os
import re
from pathlib import Path

import pytest
import yaml
from daemon_processes import Daemon, wait_until
from rclpy.action import get_action_names_and_types
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import ReliabilityPolicy
from ros_client import TOPICS, NodeProcess, RosClient
from slipguard_ros.node import PARAMETERS

PACKAGE = Path(__file__).resolve().parents[1]
README = (PACKAGE / "README.md").read_text(encoding="utf-8")
OF_EVERY_NODE = re.compile(r"/rosout|/_action/|transition|_state$|_states$|parameter|type_description")
SCRIPTS = {
    one.name for one in importlib.metadata.distribution("slipguard-ros").entry_points.select(group="console_scripts")
}


def documented() -> dict[str, str]:
    """Return the type of each name in the README's table."""
    rows = [row.split("|")[1:3] for row in re.findall(r"^\| `/.*", README, re.M)]
    return {name: re.findall(r"`([^`]+)`", kind)[0] for names, kind in rows for name in re.findall(r"`([^`]+)`", names)}


@pytest.fixture
def offered(node: NodeProcess, ros: RosClient) -> dict[str, str]:
    """Return the type of each topic, service and action of the active node."""
    found: dict[str, list[str]] = {}

    def discovered() -> bool:
        with contextlib.suppress(NodeNameNonExistentError):
            found.update(ros.node.get_publisher_names_and_types_by_node("slipguard", "/"))
            found.update(ros.node.get_service_names_and_types_by_node("slipguard", "/"))
            found.update(get_action_names_and_types(ros.node))
        return {"/diagnostics", "/slipguard/calibrate", "/slipguard/gripper_cmd"} <= set(found)

    wait_until(discovered, "the node is discovered")
    return {name: kinds[0] for name, kinds in found.items() if name in TOPICS or not OF_EVERY_NODE.search(name)}


def test_the_readme_names_everything_with_its_type(offered: dict[str, str]) -> None:
    assert documented() == offered
    commands = re.findall(r"(/slipguard/\w+) (slipguard_ros_interfaces/\S+)", README)
    assert len(commands) == 2
    assert all(offered[name] == kind for name, kind in commands)
    sockets = re.findall(r"(?:echo|:=|-r) (/slipguard/[\w/]+)|-r (/slipguard/\w+):=", README)
    assert all((one or other) in offered for one, other in sockets)
    assert {"slipguard_node", "slipguard_call", "slipguard_to_rosbag", "slipguard_ros_demo"} == SCRIPTS


def test_commands_name_files_packages_and_programs() -> None:
    drivers = PACKAGE.parent
    (shown,) = re.findall(r"`rviz2 -d (\S+)`", README)
    assert (drivers.parent / shown).is_file()
    (packages,) = re.findall(r"colcon build --packages-select ([\w ]+) &&", README)
    assert all((drivers / name / "package.xml").is_file() for name in packages.split())
    (build,) = re.findall(r"^(\S+build_for_pip)", README, re.M)
    assert os.access(drivers.parent / build, os.X_OK)
    launch = (PACKAGE / "launch" / "slipguard.launch.py").read_text()
    started = re.findall(r"ros2 (?:launch|run) slipguard_ros (\S+)", README)
    assert {"slipguard_node", "slipguard.launch.py"} == set(started)
    assert 'executable="slipguard_node"' in launch


def test_the_parameter_file_has_all_parameters_with_their_defaults(daemon: Daemon, ros: RosClient) -> None:
    file = PACKAGE / "config" / "slipguard.yaml"
    assert yaml.safe_load(file.read_text())["/**"]["ros__parameters"] == PARAMETERS
    assert set(re.findall(r"-p (\w+):=", README)) <= set(PARAMETERS)
    with NodeProcess(daemon.socket, parameter_file=file):
        wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")


def test_rviz_and_moveit_name_what_the_node_offers(offered: dict[str, str], ros: RosClient, daemon: Daemon) -> None:
    shown = yaml.safe_load((PACKAGE / "config" / "slipguard.rviz").read_text())["Visualization Manager"]
    for display in shown["Displays"]:
        topic, kind = display["Topic"], display["Class"].removeprefix("rviz_default_plugins/")
        assert kind in offered[topic["Value"]]
        qos = ros.node.get_publishers_info_by_topic(topic["Value"])[0].qos_profile
        assert topic["Reliability Policy"] == (
            "Reliable" if qos.reliability == ReliabilityPolicy.RELIABLE else "Best Effort"
        )
    wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
    assert ros.newest("/slipguard/joint_states").header.frame_id == shown["Global Options"]["Fixed Frame"]
    moveit = yaml.safe_load((PACKAGE / "config" / "moveit_controllers.yaml").read_text())
    manager = moveit["moveit_simple_controller_manager"]
    (name,) = manager["controller_names"]
    entry = manager[name]
    assert offered[f"/{name}/{entry['action_ns']}"] == f"control_msgs/action/{entry['type']}"
