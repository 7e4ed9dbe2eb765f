"""Gel images of slipguard's tactile sensors as LeRobot cameras."""

from lerobot_camera_slipguard.slipguard_camera import SlipguardCamera, SlipguardCameraConfig, StaleFrame

__all__ = ["SlipguardCamera", "SlipguardCameraConfig", "StaleFrame"]
