"""The commands and programs of both README files: LeRobot parses the commands, the programs run."""

from __future__ import annotations

import re
import shlex
from pathlib import Path
from typing import Any

import draccus
import pytest
from daemon_processes import Daemon
from lerobot.scripts.lerobot_record import RecordConfig
from lerobot.utils.import_utils import register_third_party_plugins

from lerobot_camera_slipguard import SlipguardCameraConfig

DRIVERS = Path(__file__).resolve().parents[2]
PACKAGES = ("lerobot_camera_slipguard", "lerobot_robot_slipguard")
REST = (
    *("--robot.type=so101_follower", "--robot.port=/dev/ttyACM0", "--teleop.type=so101_leader"),
    *("--teleop.port=/dev/ttyACM1", "--dataset.repo_id=me/gel", "--dataset.single_task=hold it"),
)
"""What `...` at the end of a command stands for."""
REAL_ARM, DEMO_ARM = '{"type": "so101_follower", "port": "/dev/ttyACM0"}', '{"type": "slipguard_demo_arm"}'


def blocks(package: str, language: str) -> list[str]:
    """Return the README's code blocks in a language."""
    text = (DRIVERS / package / "README.md").read_text(encoding="utf-8")
    return re.findall(rf"^```{language}\n(.*?)^```", text, re.M | re.S)


@pytest.mark.parametrize("package", PACKAGES)
def test_lerobot_record_accepts_the_documented_command(package: str) -> None:
    lines = "".join(blocks(package, "sh")).replace("\\\n", " ").splitlines()
    (words,) = (shlex.split(line)[1:] for line in lines if line.startswith("lerobot-record "))
    register_third_party_plugins()
    robot = draccus.parse(RecordConfig, args=[*words[:-1], *REST] if words[-1] == "..." else words).robot
    cameras: dict[str, Any] = robot.cameras
    assert all(isinstance(camera, SlipguardCameraConfig) for camera in cameras.values())
    if package == PACKAGES[1]:
        assert (robot.type, robot.arm_config().port) == ("slipguard", "/dev/ttyACM0")


@pytest.mark.parametrize("package", PACKAGES)
def test_the_documented_program_runs(
    package: str, daemon: Daemon, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Without the name of a socket, as documented: it is that of this user's daemon."""
    (tmp_path / "slipguard").symlink_to(daemon.folder)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    (program,) = blocks(package, "python")
    names: dict[str, Any] = {}
    exec(compile(program.replace(REAL_ARM, DEMO_ARM), f"{package}/README.md", "exec"), names)
    if package == PACKAGES[0]:
        assert all(names[image].shape == (320, 240, 3) for image in ("image", "newest"))
    else:
        assert names["sent"].keys() == {*names["robot"].action_features, "grip.force_n"}
