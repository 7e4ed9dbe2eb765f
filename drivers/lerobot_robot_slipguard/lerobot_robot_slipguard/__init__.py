"""Any LeRobot robot with a gripper that slipguard guards."""

from lerobot_robot_slipguard.config_slipguard_robot import SlipguardRobotConfig
from lerobot_robot_slipguard.demo_devices import DemoArm, DemoArmConfig, DemoPerson, DemoPersonConfig
from lerobot_robot_slipguard.slipguard_robot import SlipguardRobot

__all__ = ["DemoArm", "DemoArmConfig", "DemoPerson", "DemoPersonConfig", "SlipguardRobot", "SlipguardRobotConfig"]
