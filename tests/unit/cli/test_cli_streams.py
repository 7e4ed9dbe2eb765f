"""The command line with another encoding of its output, or without output."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

MAIN = "from slipguard.cli import main; main()"
CONFIG = Path(__file__).parents[3] / "config.toml"


@pytest.mark.parametrize("encoding", ["ascii", "latin-1"])
def test_a_terminal_with_few_characters_still_shows_the_result(encoding: str) -> None:
    command = [sys.executable, "-c", MAIN, "check", "--config", CONFIG]
    environment = os.environ | {"PYTHONIOENCODING": encoding, "COLUMNS": "60"}
    done = subprocess.run(command, capture_output=True, env=environment, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
    assert "the configuration is valid" in done.stdout.decode(encoding)


def test_a_closed_output_is_not_an_internal_error() -> None:
    command = f"exec {sys.executable} -c '{MAIN}' version >&-"
    done = subprocess.run(["sh", "-c", command], stderr=subprocess.PIPE, timeout=60, check=False)
    assert (done.returncode, done.stderr) == (0, b"")
