"""LeRobot robot `slipguard`: another robot, with a gripper that slipguard guards."""

from __future__ import annotations

import contextlib
import json
import logging
import math
import time
from collections import deque
from functools import cached_property
from typing import Any

from lerobot.cameras import Camera
from lerobot.cameras.utils import make_cameras_from_configs
from lerobot.robots import Robot, make_robot_from_config
from lerobot.utils.decorators import check_if_already_connected, check_if_not_connected

from lerobot_robot_slipguard.config_slipguard_robot import SlipguardRobotConfig
from lerobot_robot_slipguard.jaw_requests import JawRequest, JawRequests, is_held
from slipguard_client import DaemonUnreachable, LocalApi, RequestRefused, StreamThread

FORCE = "grip.force_n"
SLIP = ("valid", "rotation_deg", "sigma_deg", "age_ms")
"""Of one estimate. Without one, valid is 0 and so are the others: a NaN would make a data set's statistics NaN."""
ESTIMATES_KEPT = 240
"""Two seconds of two cameras at 60 frames per second."""
ESTIMATE_MAX_AGE_S = 0.5
"""If the newest estimate is older, the stream has ended: none is valid. The daemon judges whether frames are fresh."""
STATE_TIMEOUT_S = 2.0
STATE_MAX_AGE_S = 0.2
log = logging.getLogger(__name__)


class NotGuarding(ConnectionError):
    """The daemon runs, but cannot guard this gripper; str() says what to do."""


class SlipguardRobot(Robot):
    """Passes actions and observations of the arm on; the gripper's part goes to slipguard."""

    config_class = SlipguardRobotConfig
    name = "slipguard"

    def __init__(self, config: SlipguardRobotConfig) -> None:
        super().__init__(config)
        self.config = config
        self.arm = make_robot_from_config(config.arm_config())
        self._own_cameras = make_cameras_from_configs(config.cameras)
        self._api: LocalApi | None = None
        self._stream: StreamThread | None = None
        self.estimates: deque[dict[str, Any]] = deque(maxlen=ESTIMATES_KEPT)
        """The newest estimates of both fingers together, as the daemon's stream `/estimates` reports them."""
        self._jaws = self._new_jaws()
        self._state: dict[str, Any] = {}
        self._read_at_s = -math.inf
        self._arm_action: dict[str, Any] = {}
        self._problem: str | None = None

    @property
    def cameras(self) -> dict[str, Camera]:
        """All cameras: the arm's and the further ones."""
        return {**getattr(self.arm, "cameras", {}), **self._own_cameras}

    @cached_property
    def observation_features(self) -> dict[str, type | tuple[int, ...]]:
        """The arm's, the jaws, `grip.force_n`, the newest estimates (`slip_key`), and the further cameras."""
        slip = [slip_key(name, index) for index in range(self.config.estimates) for name in SLIP]
        own = dict.fromkeys((self.config.gripper, FORCE, *slip), float)
        images = {key: (camera.height, camera.width, 3) for key, camera in self._own_cameras.items()}
        return {**self.arm.observation_features, **own, **images}

    @cached_property
    def action_features(self) -> dict[str, type]:
        """The arm's and the jaws; with `force_in_action` also `grip.force_n`."""
        own = (self.config.gripper, FORCE) if self.config.force_in_action else (self.config.gripper,)
        return {**self.arm.action_features, **dict.fromkeys(own, float)}

    @property
    def is_connected(self) -> bool:
        """Whether arm, cameras and daemon are connected."""
        own = all(camera.is_connected for camera in self._own_cameras.values())
        return self._api is not None and own and bool(self.arm.is_connected)

    @check_if_already_connected
    def connect(self, calibrate: bool = True) -> None:
        """Connect to the daemon, then to the arm, then to the further cameras. Moves no jaws.

        Raises:
            DaemonUnreachable: a ConnectionError; no daemon responds.
            NotGuarding: a ConnectionError; the daemon is not ready, or not in guard mode.
        """
        api = LocalApi(self.config.socket)
        with contextlib.ExitStack() as undo:
            state = api.state(STATE_TIMEOUT_S)
            _check_guarding(state, api.socket_path)
            self.arm.connect(calibrate)
            undo.callback(self.arm.disconnect)
            for camera in self._own_cameras.values():
                camera.connect()
                undo.callback(camera.disconnect)
            undo.pop_all()
        self._api, self._jaws, self._state = api, self._new_jaws(), state
        self._arm_action, self._problem = {}, None
        self.estimates.clear()
        self._stream = StreamThread(api, "/estimates", self._on_estimates, lambda why: log.info("estimates: %s", why))

    @property
    def is_calibrated(self) -> bool:
        """Whether the arm is calibrated. slipguard's background images: `slipguard calibrate`."""
        return self.arm.is_calibrated

    def calibrate(self) -> None:
        """Calibrate the arm."""
        self.arm.calibrate()

    def configure(self) -> None:
        """Configure the arm."""
        self.arm.configure()

    @check_if_not_connected
    def get_observation(self) -> dict[str, Any]:
        """Return the observation of the arm, the jaws, the slip and the further cameras. All numbers are finite.

        Raises:
            DaemonUnreachable: No daemon responds. The gripper keeps its grip.
            StaleFrame: A camera has no new image.
        """
        observation = self.arm.get_observation()
        state = self._read_state()
        observation |= slip_features([*self.estimates], self.config.estimates, time.monotonic())
        observation[FORCE] = self._force_n(state)
        observation[self.config.gripper] = self._position(state)
        for key, camera in self._own_cameras.items():
            observation[key] = camera.read_latest()
        return observation

    @check_if_not_connected
    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        """Send the arm's part to the arm and the gripper's part to slipguard; return what was sent.

        While an object is held, the position returned is the present one and `grip.force_n` the guard's force: neither
        becomes less than it is. During a fault of the guard, and while no daemon responds, the arm gets no action and
        its last one is returned.

        Raises:
            ValueError: A value is missing or not finite; nothing was sent.
        """
        opening, force_n = self._requested(action)
        for_arm = {key: value for key, value in action.items() if key not in (self.config.gripper, FORCE)}
        position, sent_n = self._send_to_jaws(opening, force_n)
        if self._problem is None:
            self._arm_action = self.arm.send_action(for_arm)
        elif not self._arm_action:
            present = self.arm.get_observation()
            self._arm_action = {key: present[key] for key in for_arm if key in present}
        return {**self._arm_action, self.config.gripper: position, FORCE: sent_n}

    @check_if_not_connected
    def disconnect(self) -> None:
        """Disconnect the arm and the cameras. slipguard keeps the grip and guards on."""
        stream, self._api, self._stream = self._stream, None, None
        assert stream is not None
        with contextlib.ExitStack() as stack:
            stack.callback(stream.stop)
            for camera in self._own_cameras.values():
                stack.callback(camera.disconnect)
            self.arm.disconnect()

    def _on_estimates(self, message: bytearray) -> None:
        new = json.loads(message)
        self.estimates.append(new["rotation"] or {"captured_at_s": new["at_s"], "rotation_deg": None})

    def _new_jaws(self) -> JawRequests:
        return JawRequests(self.config.stroke_mm, self.config.release_above, self.config.release_after_s)

    def _send_to_jaws(self, opening: float, force_n: float | None) -> tuple[float, float]:
        """Send the request that an action means, if any; return position and force sent. Sets `_problem`."""
        try:
            state = self._recent_state()
        except (DaemonUnreachable, RequestRefused) as why:
            self._report(str(why))
            return self._position(self._state), self._force_n(self._state)
        fault = state["fault"]
        self._report(f"{fault['code']}: {fault['observed']}. {fault['what_to_do']}" if fault else None)
        request = self._jaws.next(opening, force_n, state, time.monotonic())
        sent = request if request is not None and self._submit(request) else None
        refused = request is not None and sent is None
        stays = refused or is_held(state) or state["phase"] != "idle"
        releases = sent is not None and sent.kind == "release"
        position = self._position(state) if stays and not releases else self._to_position(opening)
        return position, self._force_n(state) if sent is None else sent.fields.get("force_n", self._force_n(state))

    def _submit(self, request: JawRequest) -> bool:
        """Return whether the daemon accepted a request."""
        assert self._api is not None
        try:
            self._api.submit(request.kind, request.fields)
        except (DaemonUnreachable, RequestRefused) as why:
            log.warning("%s %s was not carried out: %s", request.kind, request.fields, why)
            return False
        return True

    def _report(self, problem: str | None) -> None:
        if problem is not None and problem != self._problem:
            log.error("the arm stays where it is: %s", problem)
        elif problem is None and self._problem is not None:
            log.warning("the arm follows the actions again")
        self._problem = problem

    def _read_state(self) -> dict[str, Any]:
        assert self._api is not None
        self._state, self._read_at_s = self._api.state(STATE_TIMEOUT_S), time.monotonic()
        return self._state

    def _recent_state(self) -> dict[str, Any]:
        """Return the state that the last observation has read, unless it is too old."""
        recent = time.monotonic() - self._read_at_s <= STATE_MAX_AGE_S
        return self._state if recent else self._read_state()

    def _requested(self, action: dict[str, Any]) -> tuple[float, float | None]:
        """Return opening (0 to 1) and force of an action. Raises ValueError."""
        config = self.config
        bad = [key for key in self.action_features if not _is_finite(action.get(key))]
        if bad:
            raise ValueError(f"the action has {bad[0]} = {action.get(bad[0])}; it must be a finite number")
        opening = (action[config.gripper] - config.closed_position) / (config.open_position - config.closed_position)
        force_n = action[FORCE] if config.force_in_action else 0.0
        return min(max(opening, 0.0), 1.0), force_n if force_n > 0.0 else None

    def _to_position(self, opening: float) -> float:
        config = self.config
        return config.closed_position + opening * (config.open_position - config.closed_position)

    def _position(self, state: dict[str, Any]) -> float:
        """Return the jaws' position; closed while the gripper does not respond."""
        width_mm = state["gripper"]["width_mm"] if state["gripper"] else 0.0
        return self._to_position(min(max(width_mm / self.config.stroke_mm, 0.0), 1.0))

    def _force_n(self, state: dict[str, Any]) -> float:
        """Return the commanded force per finger, the guard's floor; 0 while nothing is held."""
        if not is_held(state):
            return 0.0
        return float(max(state["target_force_n"], (state["gripper"] or {}).get("force_n", 0.0)))


def slip_key(name: str, index: int) -> str:
    """Return the name of a feature. index: 0 for the newest estimate, 1 for the one before it, and so on."""
    return f"slip.{name}" if index == 0 else f"slip.{index}.{name}"


def slip_features(estimates: list[dict[str, Any]], count: int, now_s: float) -> dict[str, float]:
    """Return the features of the newest `count` of some estimates, oldest first."""
    stale = not estimates or now_s - estimates[-1]["captured_at_s"] > ESTIMATE_MAX_AGE_S
    features = {}
    for index in range(count):
        one = estimates[-1 - index] if index < len(estimates) and not stale else None
        values = (0.0, 0.0, 0.0, 0.0)
        if one is not None and one["rotation_deg"] is not None:
            values = (1.0, one["rotation_deg"], one["sigma_deg"], 1000.0 * (now_s - one["captured_at_s"]))
        features |= {slip_key(name, index): value for name, value in zip(SLIP, values, strict=True)}
    return features


def _is_finite(value: Any) -> bool:
    return value is not None and math.isfinite(value)


def _check_guarding(state: dict[str, Any], socket: str) -> None:
    """Raise NotGuarding if the daemon cannot guard what this robot grips."""
    if state["mode"] != "guard":
        reason = 'its mode is "lift": set guard.mode = "guard" in its config.toml, because LeRobot moves the arm'
    elif state["waiting_for"]:
        reason = f"it is not ready: {'; '.join(state['waiting_for'])}. See `slipguard doctor`"
    elif not state["guarding"]:
        reason = "the guard is switched off: `slipguard ctl guard on`"
    else:
        return
    raise NotGuarding(f"the daemon at {socket} does not guard: {reason}")
