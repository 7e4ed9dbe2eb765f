"""The README files, and the commands in them."""

from __future__ import annotations

import re
from collections.abc import Iterator

import pytest
from sandbox import ROOT

FOLDERS = (
    "",
    "slipguard",
    "drivers",
    "drivers/slipguard_ros",
    "drivers/lerobot_camera_slipguard",
    "drivers/lerobot_robot_slipguard",
    "systemd",
    "tests",
    "models",
    ".github",
    "docs/pages",
)
FILES = [path for folder in FOLDERS for path in sorted((ROOT / folder).glob("*.md"))]
each_file = pytest.mark.parametrize("path", FILES, ids=lambda path: path.relative_to(ROOT).as_posix())


def _steps(block: str) -> Iterator[str]:
    for line in block.replace("\\\n", " ").splitlines():
        yield from (step.strip() for step in re.split(r"&&|;", line.partition(" #")[0]))


def code(text: str) -> Iterator[str]:
    """Yield the commands of all code blocks, and what stands between back-ticks."""
    parts = re.split(r"^ *```.*$", text, flags=re.M)
    for block in parts[1::2]:
        yield from _steps(block)
    for prose in parts[::2]:
        for quoted in re.findall(r"`([^`\n]+)`", prose):
            yield from quoted.split(" && ")
