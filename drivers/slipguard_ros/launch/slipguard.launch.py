"""Start the node: `ros2 launch slipguard_ros slipguard.launch.py`, with `params:=FILE` for other parameters."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import LifecycleNode


def generate_launch_description():
    """Return the node, which is started again if it ends."""
    default = Path(__file__).resolve().parent.parent / "config" / "slipguard.yaml"
    params = DeclareLaunchArgument("params", default_value=str(default), description="Parameter file of the node.")
    node = LifecycleNode(
        package="slipguard_ros",
        executable="slipguard_node",
        name="slipguard",
        namespace="",
        parameters=[LaunchConfiguration("params")],
        output="screen",
        respawn=True,
        respawn_delay=1.0,
    )
    return LaunchDescription([params, node])
