"""The guarded robot: what reaches the arm, the jaws and the policy."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import pytest
from daemon_processes import Daemon, is_busy, wait_until
from lerobot.robots import make_robot_from_config

from lerobot_camera_slipguard import SlipguardCameraConfig
from lerobot_robot_slipguard import SlipguardRobot, SlipguardRobotConfig
from lerobot_robot_slipguard.slipguard_robot import SLIP, NotGuarding, _check_guarding, slip_features
from slipguard_client import DaemonUnreachable, LocalApi

OPEN, CLOSED = 100.0, 0.0


def make(daemon: Daemon, **changes: Any) -> SlipguardRobot:
    cameras = {"gel_left": SlipguardCameraConfig(finger="left", max_age_ms=5000, socket=daemon.socket)}
    config = SlipguardRobotConfig(
        arm={"type": "slipguard_demo_arm", "socket": daemon.socket}, socket=daemon.socket, cameras=cameras, **changes
    )
    made = make_robot_from_config(config)
    assert isinstance(made, SlipguardRobot)
    return made


@pytest.fixture
def robot(daemon: Daemon) -> Iterator[SlipguardRobot]:
    """Connected, with open jaws; what it holds at the end is released."""
    robot = make(daemon, force_in_action=True)
    robot.connect()
    yield robot
    if robot.is_connected:
        robot.disconnect()
    daemon.release()


def act(robot: SlipguardRobot, gripper: float, force_n: float = 0.0, height: float = 0.0) -> dict[str, Any]:
    robot.get_observation()
    action = {"height.pos": height, "gripper.pos": gripper, "grip.force_n": force_n}
    return robot.send_action(action)


def close_on_object(daemon: Daemon, robot: SlipguardRobot) -> dict[str, Any]:
    def held() -> dict[str, Any] | None:
        act(robot, CLOSED)
        state = daemon.state()
        return state if state["phase"] == "holding" else None

    return dict(wait_until(held, "held"))


def test_features_match_what_is_returned(daemon: Daemon, robot: SlipguardRobot) -> None:
    observation = robot.get_observation()
    assert set(observation) == set(robot.observation_features)
    assert observation["gel_left"].shape == robot.observation_features["gel_left"]
    sent = act(robot, OPEN, height=120.0)
    assert set(sent) == set(robot.action_features)
    assert robot.arm.sent[-1] == {"height.pos": 120.0}, "the arm receives its part, and only that"
    assert sent["height.pos"] == 90.0, "as the arm limited it"
    assert {"slip.valid", "slip.rotation_deg", "slip.3.age_ms", "grip.force_n"} < set(robot.observation_features)
    assert list(make(daemon).action_features) == ["height.pos", "gripper.pos"], "what a teleoperator gives"


def test_validity_is_a_flag_of_its_own() -> None:
    now_s = 100.0

    def one(age_s: float, rotation_deg: float | None) -> dict[str, Any]:
        return {"captured_at_s": now_s - age_s, "rotation_deg": rotation_deg, "sigma_deg": rotation_deg and 0.2}

    estimates = [one(0.06, 1.0), one(0.04, 2.0), one(0.02, None)]
    newest, before = (slip_features(estimates, count, now_s) for count in (1, 4))
    assert newest == {"slip.valid": 0.0, "slip.rotation_deg": 0.0, "slip.sigma_deg": 0.0, "slip.age_ms": 0.0}
    assert [before[f"slip.1.{name}"] for name in SLIP] == [1.0, 2.0, 0.2, pytest.approx(40.0)]
    assert [before[f"slip.2.{name}"] for name in SLIP] == [1.0, 1.0, 0.2, pytest.approx(60.0)]
    assert before["slip.3.valid"] == 0.0
    assert not any(slip_features([one(0.6, 1.0)], 2, now_s).values()), "too old"


def test_every_estimate_is_received_with_its_capture_time(daemon: Daemon, robot: SlipguardRobot) -> None:
    assert robot.get_observation()["slip.valid"] == 0.0, "nothing is held"
    close_on_object(daemon, robot)
    robot.estimates.clear()
    wait_until(lambda: len(robot.estimates) == robot.estimates.maxlen, "estimates")
    captured_s = [one["captured_at_s"] for one in robot.estimates]
    rate_hz = (len(captured_s) - 1) / (captured_s[-1] - captured_s[0])
    print(f"{rate_hz:.1f} estimates per second")
    assert rate_hz > 55.0 or is_busy()
    observation = robot.get_observation()
    assert [observation[f"slip.{index}valid"] for index in ("", "1.", "2.", "3.")] == [1.0] * 4
    ages_ms = [observation[f"slip.{index}age_ms"] for index in ("", "1.", "2.", "3.")]
    assert ages_ms == sorted(ages_ms)


def test_grip_guard_and_release(daemon: Daemon, robot: SlipguardRobot) -> None:
    state = close_on_object(daemon, robot)
    observation = robot.get_observation()
    assert observation["grip.force_n"] == pytest.approx(state["target_force_n"], abs=1.0)
    assert (observation["slip.valid"], 0.0 < observation["slip.sigma_deg"] < 30.0) == (1.0, True)
    sent = act(robot, CLOSED, force_n=5.0)
    assert sent["grip.force_n"] >= state["target_force_n"] - 0.1, "the guard's force is the floor"
    assert sent["gripper.pos"] == pytest.approx(observation["gripper.pos"], abs=5.0), "the jaws stay on the object"
    act(robot, CLOSED, force_n=state["target_force_n"] + 20.0)
    wait_until(lambda: daemon.state()["target_force_n"] > state["target_force_n"] + 15.0, "tightened as requested")
    for _ in range(5):  # a short opening
        act(robot, OPEN)
    act(robot, 80.0)
    assert daemon.state()["phase"] not in ("released", "idle"), "kept"
    wait_until(lambda: act(robot, OPEN) and daemon.state()["phase"] in ("released", "idle"), "released")
    wait_until(lambda: daemon.state()["gripper"]["width_mm"] > 70.0, "open")


def test_a_policy_that_commands_open_jaws_does_not_drop_what_another_client_gripped(
    daemon: Daemon, robot: SlipguardRobot
) -> None:
    act(robot, OPEN)
    daemon.grasp()
    ends_s = time.monotonic() + 1.0
    while time.monotonic() < ends_s:
        act(robot, OPEN)
    assert daemon.state()["phase"] == "holding"


@pytest.mark.parametrize("wrong", [{"gripper.pos": math.nan}, {"gripper.pos": None}, {"height.pos": math.inf}])
def test_an_invalid_action_sends_nothing(robot: SlipguardRobot, wrong: dict[str, Any]) -> None:
    action = {"height.pos": 1.0, "gripper.pos": OPEN, "grip.force_n": 0.0}
    with pytest.raises(ValueError, match="must be a finite number"):
        robot.send_action(action | wrong)
    assert not robot.arm.sent


def test_during_a_fault_the_arm_stays_and_the_jaws_stay(
    daemon: Daemon, robot: SlipguardRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    close_on_object(daemon, robot)
    act(robot, CLOSED, height=30.0)
    fault = {"code": "frames lost", "observed": "no good frame for 0.5 s", "what_to_do": "check the cables"}
    monkeypatch.setattr(LocalApi, "state", lambda self, *_, read=LocalApi.state: read(self) | {"fault": fault})
    before = len(robot.arm.sent)
    for _ in range(30):
        sent = act(robot, OPEN, height=60.0)
        time.sleep(1 / 30)
    assert len(robot.arm.sent) == before, "the arm got nothing"
    assert sent["height.pos"] == 30.0, "what was sent last"
    monkeypatch.undo()
    assert daemon.state()["gripper"]["holding"], "a policy releases nothing during a fault"
    assert act(robot, CLOSED, height=60.0)["height.pos"] == 60.0, "the arm follows again"


def test_without_a_daemon_the_arm_stays_too(
    daemon: Daemon, robot: SlipguardRobot, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreachable(self: LocalApi, *_: float) -> None:
        raise DaemonUnreachable("no slipguard daemon responds")

    act(robot, OPEN, height=10.0)
    robot._read_at_s = -math.inf  # as after a pause
    monkeypatch.setattr(LocalApi, "state", unreachable)
    with pytest.raises(DaemonUnreachable):
        robot.get_observation()
    action = {"height.pos": 50.0, "gripper.pos": OPEN, "grip.force_n": 0.0}
    sent = robot.send_action(action)
    assert sent["height.pos"] == 10.0
    assert sent["grip.force_n"] == 0.0


def test_connecting_says_what_is_missing(daemon: Daemon) -> None:
    robot = make(daemon)
    robot.config.socket = "/nowhere/slipguard.sock"
    with pytest.raises(DaemonUnreachable, match="slipguard run"):
        robot.connect()
    assert not robot.is_connected
    assert not robot.arm.is_connected
    for change, hint in (
        ({"mode": "lift"}, 'guard.mode = "guard"'),
        ({"waiting_for": ["gripper: not activated"]}, "not activated"),
        ({"guarding": False}, "guard on"),
    ):
        with pytest.raises(NotGuarding, match=hint):
            _check_guarding(daemon.state() | change, daemon.socket)
    with pytest.raises(ValueError, match="nothing_like_it"):
        SlipguardRobotConfig(arm={"type": "nothing_like_it"}).arm_config()
