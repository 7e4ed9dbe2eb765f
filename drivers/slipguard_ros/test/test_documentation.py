"""README, launch file, parameter file and RViz configuration name what the node really offers."""

from __future__ import annotations

import contextlib
import importlib.metadata
import re
import runpy
import shlex
import sys
import types
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
import yaml
from rclpy.node import NodeNameNonExistentError
from rclpy.qos import ReliabilityPolicy
from ros_client import RosClient
from rosprocesses import NodeProcess, SimulatedDaemon, wait_until
from slipguard_ros.node import PARAMETERS

PACKAGE = Path(__file__).resolve().parents[1]
NAME = "slipguard_ros"
README = (PACKAGE / "README.md").read_text(encoding="utf-8")
OF_EVERY_NODE = ("/rosout", "/parameter_events", "/slipguard/transition_event")
RVIZ_TYPES = {
    "Image": "sensor_msgs/msg/Image",
    "PoseWithCovariance": "geometry_msgs/msg/PoseWithCovarianceStamped",
    "Wrench": "geometry_msgs/msg/WrenchStamped",
}
"""The message that each display of rviz_default_plugins subscribes to."""
STATIC_TRANSFORM = re.compile(r"--(frame-id|child-frame-id|x|y|z|qx|qy|qz|qw|roll|pitch|yaw)$")


class Offered:
    """What the running node offers: types by the names of topics and services."""

    def __init__(self, ros: RosClient) -> None:
        node = ros.node

        def names() -> bool:
            with contextlib.suppress(NodeNameNonExistentError):
                self.topics = dict(node.get_publisher_names_and_types_by_node("slipguard", "/"))
                self.services = dict(node.get_service_names_and_types_by_node("slipguard", "/"))
                return "/diagnostics" in self.topics and "/slipguard/calibrate" in self.services
            return False

        wait_until(names, "the node is discovered")
        self.reliable = {
            topic: node.get_publishers_info_by_topic(topic)[0].qos_profile.reliability == ReliabilityPolicy.RELIABLE
            for topic in self.topics
        }


@pytest.fixture
def offered(node: NodeProcess, ros: RosClient) -> Offered:
    """Everything that the active node offers."""
    wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")
    return Offered(ros)


def table(heading: str) -> list[tuple[list[str], str]]:
    """Return the names and the type in each row of the README's table under a heading."""
    section = re.split(r"^## ", README, flags=re.M)
    (text,) = (part for part in section if part.startswith(f"{heading}\n"))
    rows = [row.split("|")[1:] for row in re.findall(r"^\| `.*", text, re.M)]
    return [(re.findall(r"`([^`]+)`", names), re.findall(r"`([^`]+)`", kind)[0]) for names, kind, *_ in rows]


def commands() -> list[list[str]]:
    """Return the words of every command of the README's blocks, and of those of ROS between back-ticks."""
    blocks = re.findall(r"^```sh\n(.*?)^```", README, re.M | re.S)
    lines = "".join(blocks).replace("\\\n", " ").splitlines()
    prose = re.findall(r"`((?:ros2|rviz2|colcon|slipguard_node|slipguard_to_rosbag) [^`]+)`", README)
    steps = [shlex.split(step) for line in (*lines, *prose) for step in line.split("&&")]
    return [words for words in steps if len(words) > 2]


def test_the_readme_names_every_topic_with_its_type(offered: Offered) -> None:
    documented = {name: kind.replace("/", "/msg/") for names, kind in table("Topics") for name in names}
    found = {name: kinds[0] for name, kinds in offered.topics.items() if "/_action/" not in name}
    assert documented == {name: kind for name, kind in found.items() if name not in OF_EVERY_NODE}


def test_the_readme_names_every_service_with_its_type(offered: Offered) -> None:
    documented = {
        f"/slipguard/{name.removeprefix('/slipguard/')}": kind.replace("/", "/srv/")
        for names, kind in table("Services")
        for name in names
    }
    assert documented == {name: kinds[0] for name, kinds in offered.services.items() if "std_srvs" in kinds[0]}


def test_the_commands_of_the_readme_name_what_exists(offered: Offered) -> None:
    for words in commands():
        check_command(words, offered)


WRONG = (
    "ros2 service call /slipguard/grab std_srvs/srv/Trigger",
    "ros2 service call /slipguard/grasp std_srvs/srv/SetBool",
    "ros2 topic echo /slipguard/angle",
    "ros2 launch slipguard_ros slipguard.launch",
    "ros2 launch slipguard_ros slipguard.launch.py config:=FILE",
    "ros2 run slipguard_ros node",
    "ros2 run slipguard_ros slipguard_node --ros-args -p joint:=finger_joint",
    "ros2 run slipguard_ros slipguard_node --ros-args -p joint_scale:=fast",
    "ros2 run slipguard_ros slipguard_node --ros-args -r /slipguard/joints:=/joint_states",
    "ros2 run tf2_ros static_transform_publisher --frame-id tool0 --child-frame-id gripper",
    "ros2 action info /slipguard/gripper",
    "colcon build --packages-select slipguard",
    "rviz2 -d drivers/slipguard_ros/config/rviz.rviz",
    "slipguard_to_rosbag --format mcap recording.mcap bag",
)


def test_a_wrong_name_is_detected(offered: Offered) -> None:
    for wrong in WRONG:
        with pytest.raises((AssertionError, ValueError, KeyError)):
            check_command(shlex.split(wrong), offered)


def check_command(words: list[str], offered: Offered) -> None:
    """Check the names in a command line. Raises AssertionError, ValueError or KeyError."""
    while re.fullmatch(r"\w+=\S+", words[0]):
        words = words[1:]
    program, *rest = words
    match Path(program).name, rest:
        case "ros2", ["service", "call", name, kind]:
            assert offered.services[name] == [kind]
        case "ros2", ["topic", "echo", name]:
            assert name in offered.topics
        case "ros2", ["launch", package, file, *arguments]:
            assert package == NAME
            assert (PACKAGE / "launch" / file).is_file()
            assert {one.partition(":=")[0] for one in arguments} <= {"params"}
        case "ros2", ["run", "tf2_ros", "static_transform_publisher", *options]:
            assert all(STATIC_TRANSFORM.match(one) for one in options[::2])
            assert options[options.index("--child-frame-id") + 1] == f"{PARAMETERS['frame_prefix']}grasp"
        case "ros2", ["run", package, executable, *options]:
            assert package == NAME
            check_executable(executable, options, offered)
        case "ros2", ["bag", "info" | "play", _]:
            pass
        case "rviz2", ["-d", file]:
            assert (PACKAGE.parents[1] / file).is_file()
        case "colcon", ["build", "--packages-select", package]:
            assert package == ElementTree.parse(PACKAGE / "package.xml").findtext("name")
        case ("slipguard_node" | "slipguard_to_rosbag") as executable, options:
            check_executable(executable, options, offered)
        case other, _:
            assert other in ("cp", "cd", "source", "python3.11", "pip", "slipguard"), words


def check_executable(name: str, options: list[str], offered: Offered) -> None:
    """Check an executable of this package and its options."""
    scripts = importlib.metadata.distribution("slipguard-ros").entry_points.select(group="console_scripts")
    assert name in {one.name for one in scripts}
    if name == "slipguard_to_rosbag":
        assert all(one in ("--storage",) for one in options if one.startswith("-"))
        return
    for option, value in zip(options[1::2], options[2::2], strict=True):
        left, _, right = value.partition(":=")
        if option == "-p":
            kind = type(PARAMETERS[left])
            assert kind is not bool or right in ("true", "false")
            kind(right)
        else:
            assert option == "-r"
            assert left in offered.topics


def test_the_launch_file_starts_the_installed_node(monkeypatch: pytest.MonkeyPatch) -> None:
    """With classes that record their arguments: `launch` and `launch_ros` are not on PyPI."""

    class Recorded:
        def __init__(self, *given: Any, **fields: Any) -> None:
            self.given, self.fields = given, fields

    for module, names in {
        "launch": ("LaunchDescription",),
        "launch.actions": ("DeclareLaunchArgument",),
        "launch.substitutions": ("LaunchConfiguration",),
        "launch_ros.actions": ("LifecycleNode",),
    }.items():
        made = types.ModuleType(module)
        for name in names:
            setattr(made, name, type(name, (Recorded,), {}))
        monkeypatch.setitem(sys.modules, module, made)
    installed = Path(sys.prefix) / "share" / NAME / "launch" / "slipguard.launch.py"
    description = runpy.run_path(str(installed))["generate_launch_description"]()
    argument, node = description.given[0]
    assert argument.given == ("params",)
    assert Path(argument.fields["default_value"]).is_file()
    assert node.fields["parameters"][0].given == argument.given
    assert (node.fields["package"], node.fields["name"], node.fields["namespace"]) == (NAME, "slipguard", "")
    scripts = importlib.metadata.distribution("slipguard-ros").entry_points.select(group="console_scripts")
    assert node.fields["executable"] in {one.name for one in scripts}


def test_the_parameter_file_has_all_parameters_with_their_defaults(daemon: SimulatedDaemon, ros: RosClient) -> None:
    file = PACKAGE / "config" / "slipguard.yaml"
    assert yaml.safe_load(file.read_text())["/**"]["ros__parameters"] == PARAMETERS
    with NodeProcess(daemon.socket, parameter_file=file):
        wait_until(lambda: "/slipguard/joint_states" in ros.received, "the node is active")


def test_rviz_shows_what_the_node_publishes(offered: Offered, ros: RosClient, daemon: SimulatedDaemon) -> None:
    shown = yaml.safe_load((PACKAGE / "config" / "slipguard.rviz").read_text())["Visualization Manager"]
    for display in shown["Displays"]:
        topic, kind = display["Topic"], display["Class"].removeprefix("rviz_default_plugins/")
        assert offered.topics[topic["Value"]] == [RVIZ_TYPES[kind]]
        assert topic["Reliability Policy"] == ("Reliable" if offered.reliable[topic["Value"]] else "Best Effort")
    assert ros.newest("/slipguard/joint_states").header.frame_id == shown["Global Options"]["Fixed Frame"]
