"""For colcon (ament_python) and for pip. Humble's setuptools reads metadata from here only."""

from setuptools import setup

setup(
    name="slipguard_client",
    version="0.1.0",
    description="Client of slipguard's local API, for ROS 2 and LeRobot",
    license="MIT",
    author="The slipguard developers",
    python_requires=">=3.10",
    py_modules=["slipguard_client", "slipguard_demo"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/slipguard_client"]),
        ("share/slipguard_client", ["package.xml"]),
    ],
)
