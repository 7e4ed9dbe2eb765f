"""The files of an emulated cell, with its configuration for `slipguard run`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from slipguard.errors import InputError

MARK = "# written by `slipguard emulate cell`; the next one in this folder replaces it\n"
SOCKET_PATH_MAX_BYTES = 107
"""`sun_path` of Linux, less its closing zero."""


@dataclass(frozen=True, slots=True)
class CellPaths:
    """The paths of one cell's files. folder: absolute."""

    folder: Path

    @property
    def config(self) -> Path:
        """The configuration."""
        return self.folder / "config.toml"

    @property
    def truth(self) -> Path:
        """The true states, as JSON lines."""
        return self.folder / "truth.jsonl"

    @property
    def gripper(self) -> Path:
        """The gripper's serial port."""
        return self.folder / "ttyGripper"

    def camera(self, finger: str) -> Path:
        """A finger's socket."""
        return self.folder / f"{finger}.sock"

    @property
    def api(self) -> Path:
        """The socket of the daemon for this cell."""
        return self.folder / "slipguard.sock"

    def make(self) -> None:
        """Create the folder. Raises InputError if it cannot be used."""
        longest = max((self.api, self.camera("right")), key=lambda path: len(str(path)))
        if len(str(longest).encode()) > SOCKET_PATH_MAX_BYTES:
            raise InputError(
                f"{longest}: longer than the {SOCKET_PATH_MAX_BYTES} bytes of a socket's path; use a shorter folder"
            )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            if self.config.exists() and not self.config.read_text().startswith(MARK):
                raise InputError(f"{self.config} exists and was not written by an emulated cell; name another folder")
        except OSError as error:
            raise InputError(f"{self.folder}: cannot be used: {error.strerror}; name another folder") from None


def config_text(
    places: CellPaths,
    *,
    gripper: Mapping[str, str],
    mode: Literal["lift", "guard"],
    host: str,
    height_mm: float,
    speed_mm_s: float,
) -> str:
    """Return the configuration as text; other keys have slipguard's defaults. gripper: how the gripper is connected."""
    connection = "\n".join(f'{key} = "{value}"' for key, value in gripper.items())
    cameras = "\n".join(
        f"""[{finger}]
driver = "socket"
[{finger}.socket]
path = "{places.camera(finger)}"
"""
        for finger in ("left", "right")
    )
    return f"""{MARK}
{cameras}
[gripper]
driver = "robotiq"
[gripper.robotiq]
{connection}

[arm]
driver = "ur5"
[arm.ur5]
host = "{host}"

[guard]
mode = "{mode}"
lift_height_mm = {height_mm:g}
lift_speed_mm_s = {speed_mm_s:g}

[api]
socket = "{places.api}"

[state]
directory = "{places.folder / "state"}"
"""
