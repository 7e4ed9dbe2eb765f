"""The check against LeRobot's source finds what does not fit, for machines where LeRobot does not run."""

from __future__ import annotations

import shutil
from pathlib import Path

import lerobot
from check_source import differences

SOURCE = Path(lerobot.__file__).parent
FILES = ("cameras/camera.py", "robots/robot.py", "utils/import_utils.py")


def test_camera_and_robot_fit_the_installed_lerobot() -> None:
    assert not differences(SOURCE)


def test_a_changed_base_class_is_reported(tmp_path: Path) -> None:
    for name in FILES:
        (tmp_path / name).parent.mkdir(parents=True)
        shutil.copy(SOURCE / name, tmp_path / name)
    camera = tmp_path / FILES[0]
    text = camera.read_text().replace("timeout_ms: float = ...", "limit_ms: float = ...")
    camera.write_text(f"{text}\n    @abc.abstractmethod\n    def zoom(self) -> None: ...\n")
    first, second = differences(tmp_path)
    assert "async_read has the parameters" in first
    assert second == "SlipguardCamera.zoom is missing"
