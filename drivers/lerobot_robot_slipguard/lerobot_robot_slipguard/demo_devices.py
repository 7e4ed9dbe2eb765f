"""An arm and a person without hardware, for the demo and the tests; LeRobot finds them by their names."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from slipguard_client import LocalApi

HEIGHT = "height.pos"
OPEN, CLOSED = 100.0, 0.0


class Connection:
    """What every device of LeRobot needs apart from its data: this one has nothing to connect or to calibrate."""

    is_connected = False
    is_calibrated = True

    def connect(self, calibrate: bool = True) -> None:
        self.is_connected = True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def disconnect(self) -> None:
        self.is_connected = False


@RobotConfig.register_subclass("slipguard_demo_arm")
@dataclass(kw_only=True)
class DemoArmConfig(RobotConfig):
    """socket: the daemon that observes the arm."""

    socket: str = ""


class DemoArm(Connection, Robot):
    """The arm of a simulated cell, whose own program lifts what is gripped: actions do not move it.

    sent: all actions.
    """

    config_class = DemoArmConfig
    name = "slipguard_demo_arm"
    observation_features: ClassVar = {HEIGHT: float}
    action_features: ClassVar = {HEIGHT: float}

    def __init__(self, config: DemoArmConfig) -> None:
        super().__init__(config)
        self._api = LocalApi(config.socket)
        self.sent: list[dict[str, Any]] = []

    def get_observation(self) -> dict[str, Any]:
        return {HEIGHT: (self._api.state()["arm"] or {}).get("height_mm", 0.0)}

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.sent.append(action)
        return {HEIGHT: min(action[HEIGHT], 90.0)}  # a limit of its own


@TeleoperatorConfig.register_subclass("slipguard_demo_person")
@dataclass(kw_only=True)
class DemoPersonConfig(TeleoperatorConfig):
    """closed_s, opened_s: when the jaws are closed and opened, in seconds after the first action."""

    closed_s: float = 0.5
    opened_s: float = 8.0


class DemoPerson(Connection, Teleoperator):
    """Closes and opens the jaws by time."""

    config_class = DemoPersonConfig
    name = "slipguard_demo_person"
    action_features: ClassVar = {HEIGHT: float, "gripper.pos": float}
    feedback_features: ClassVar = {}

    def __init__(self, config: DemoPersonConfig) -> None:
        super().__init__(config)
        self._config, self._began_s = config, 0.0

    def get_action(self) -> dict[str, Any]:
        self._began_s = self._began_s or time.monotonic()
        closed = self._config.closed_s <= time.monotonic() - self._began_s < self._config.opened_s
        return {HEIGHT: 0.0, "gripper.pos": CLOSED if closed else OPEN}

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
