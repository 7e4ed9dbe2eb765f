"""Configuration of a robot with a guarded gripper, `--robot.type=slipguard --robot.arm='{type: ...}'`."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import draccus
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("slipguard")
@dataclass(kw_only=True)
class SlipguardRobotConfig(RobotConfig):
    """arm: the configuration of the robot that carries the gripper, such as {type: so101_follower, port: /dev/ttyACM0}.

    cameras: further cameras, such as the gel images; the arm's own stay in `arm`.
    gripper: key of the jaws in actions and observations. An action of the arm with this key does not reach the arm.
    closed_position, open_position: values of that key with the jaws closed, and `stroke_mm` apart.
    release_above: share of the opening, 0 to 1; only a position above it, commanded for `release_after_s`, releases a
        held object.
    force_in_action: actions gain `grip.force_n`, the requested force per finger in newtons.
    estimates: how many of the newest rotation estimates an observation has. Two fingers give up to 120 per second.
    socket: path of the daemon's Unix socket; empty for the daemon that runs on this machine.
    """

    arm: dict[str, Any]
    cameras: dict[str, CameraConfig] = field(default_factory=dict)
    gripper: str = "gripper.pos"
    closed_position: float = 0.0
    open_position: float = 100.0
    stroke_mm: float = 85.0
    release_above: float = 0.9
    release_after_s: float = 0.3
    force_in_action: bool = False
    estimates: int = 4
    socket: str = ""

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.open_position == self.closed_position:
            raise ValueError(f"open_position and closed_position are both {self.open_position}; they must differ")
        if not 0.5 <= self.release_above < 1.0:
            raise ValueError(f"release_above is {self.release_above}; it must be at least 0.5 and below 1")
        if not 1 <= self.estimates <= 64:
            raise ValueError(f"estimates is {self.estimates}; it must be 1 to 64")
        if self.release_after_s < 0.0 or self.stroke_mm <= 0.0:
            raise ValueError(
                f"release_after_s is {self.release_after_s}, stroke_mm {self.stroke_mm}; neither may be negative or 0"
            )

    def arm_config(self) -> RobotConfig:
        """Return the arm's configuration. Raises ValueError if it is not valid."""
        try:
            return draccus.decode(RobotConfig, self.arm)
        except Exception as error:  # draccus raises various errors
            raise ValueError(f"arm: {error}. Write it as {{type: so101_follower, port: /dev/ttyACM0}}") from error
