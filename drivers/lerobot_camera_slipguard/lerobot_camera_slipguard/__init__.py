"""Gel images of slipguard's tactile sensors as LeRobot cameras."""

from lerobot_camera_slipguard.config_slipguard_camera import SlipguardCameraConfig
from lerobot_camera_slipguard.local_api import DaemonUnreachable, LocalApi, RequestRefused
from lerobot_camera_slipguard.slipguard_camera import SlipguardCamera, StaleFrame

__all__ = ["DaemonUnreachable", "LocalApi", "RequestRefused", "SlipguardCamera", "SlipguardCameraConfig", "StaleFrame"]
