"""An arm without hardware, and a person who grips and releases on a schedule, for LeRobot to discover."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

JOINTS = ("shoulder.pos", "elbow.pos")
OPEN, CLOSED = 100.0, 0.0


class Connection:
    """What every device of LeRobot needs apart from its data: this one has nothing to connect or to calibrate."""

    _connected = False

    @property
    def is_connected(self) -> bool:
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    @property
    def is_calibrated(self) -> bool:
        return True

    def calibrate(self) -> None: ...

    def configure(self) -> None: ...

    def disconnect(self) -> None:
        self._connected = False


@RobotConfig.register_subclass("scripted_arm")
@dataclass(kw_only=True)
class ScriptedArmConfig(RobotConfig):
    """No options."""


class ScriptedArm(Connection, Robot):
    """Is where it was sent. sent: all actions, for the tests."""

    config_class = ScriptedArmConfig
    name = "scripted_arm"

    def __init__(self, config: ScriptedArmConfig) -> None:
        super().__init__(config)
        self.sent: list[dict[str, Any]] = []
        self._positions = dict.fromkeys(JOINTS, 0.0)

    @property
    def observation_features(self) -> dict[str, type]:
        return dict.fromkeys(JOINTS, float)

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys(JOINTS, float)

    def get_observation(self) -> dict[str, Any]:
        return dict(self._positions)

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        self.sent.append(action)
        self._positions = {key: min(action[key], 90.0) for key in JOINTS}  # a limit of its own
        return dict(self._positions)


@TeleoperatorConfig.register_subclass("scripted_person")
@dataclass(kw_only=True)
class ScriptedPersonConfig(TeleoperatorConfig):
    """closed_s, opened_s: when the jaws are closed and opened in each period, in seconds."""

    period_s: float
    closed_s: float
    opened_s: float


class ScriptedPerson(Connection, Teleoperator):
    """Repeats a schedule, from the first action on."""

    config_class = ScriptedPersonConfig
    name = "scripted_person"

    def __init__(self, config: ScriptedPersonConfig) -> None:
        super().__init__(config)
        self._config = config
        self._began_s: float | None = None

    @property
    def action_features(self) -> dict[str, type]:
        return dict.fromkeys((*JOINTS, "gripper.pos"), float)

    @property
    def feedback_features(self) -> dict[str, type]:
        return {}

    def get_action(self) -> dict[str, Any]:
        now_s = time.monotonic()
        self._began_s = now_s if self._began_s is None else self._began_s
        t_s = (now_s - self._began_s) % self._config.period_s
        closed = self._config.closed_s <= t_s < self._config.opened_s
        return {"shoulder.pos": 10.0 * t_s, "elbow.pos": -5.0 * t_s, "gripper.pos": CLOSED if closed else OPEN}

    def send_feedback(self, feedback: dict[str, Any]) -> None: ...
