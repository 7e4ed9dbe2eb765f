"""For colcon (ament_python) and for pip. Humble's setuptools reads metadata from here only."""

from glob import glob

from setuptools import setup

PACKAGE = "slipguard_ros"

setup(
    name="slipguard-ros",
    version="0.1.0",
    description="ROS 2 node for slipguard, which keeps a robot from dropping what it holds",
    license="MIT",
    author="The slipguard developers",
    python_requires=">=3.10",
    packages=[PACKAGE],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", glob("launch/*.py")),
        (f"share/{PACKAGE}/config", glob("config/*")),
    ],
    install_requires=["setuptools", "slipguard_client"],
    extras_require={
        # Without an installation of ROS: Kilted from PyPI, for Python 3.11.
        "kilted": [
            "ros-kilted-rclpy",
            "ros-kilted-rmw-fastrtps-cpp",
            "ros-kilted-sensor-msgs",
            "ros-kilted-diagnostic-msgs",
            "ros-kilted-std-srvs",
            "ros-kilted-lifecycle-msgs",
        ],
        "demo": ["matplotlib"],
        "rosbag": ["rosbags>=0.10", "mcap>=1.2", "mcap-protobuf-support>=0.5", "lz4", "zstandard"],
    },
    entry_points={
        "console_scripts": [
            f"slipguard_node = {PACKAGE}.node:main",
            f"slipguard_call = {PACKAGE}.interfaces:main",
            f"slipguard_ros_demo = {PACKAGE}.demo:main",
            f"slipguard_to_rosbag = {PACKAGE}.rosbag:main",
        ]
    },
)
