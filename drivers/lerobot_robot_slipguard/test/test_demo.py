"""The demo: LeRobot's own program records in a simulated cell, its loader reads the data sets."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch
from daemon_processes import slipguard_python
from lerobot.datasets import LeRobotDataset

SLIP = [f"slip{index}.{name}" for index in ("", ".1", ".2", ".3") for name in ("valid", "rotation_deg", "sigma_deg")]


def test_both_episodes_are_recorded_and_read(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder: Path = tmp_path_factory.mktemp("d") / "demo"
    program = folder.parent / "slipguard"
    program.write_text(f'#!/bin/sh\nexec {slipguard_python()} -m slipguard "$@"\n')
    program.chmod(0o700)
    command = [sys.executable, "-m", "lerobot_robot_slipguard.demo", str(program), str(folder)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=400.0, check=False)
    assert done.returncode == 0, done.stdout[-2000:] + done.stderr[-2000:]
    print(done.stdout)
    assert (folder / "slip.png").stat().st_size > 10_000
    for title in ("guarded", "unguarded"):
        dataset = LeRobotDataset(f"demo/{title}", root=folder / title)
        names = dataset.features["observation.state"]["names"]
        assert set(SLIP) < set(names)
        assert dataset.features["action"]["names"] == ["height.pos", "gripper.pos"]
        states = torch.stack(list(dataset.hf_dataset.select_columns("observation.state")["observation.state"]))
        assert states.isfinite().all()
        valid = states[:, names.index("slip.valid")] > 0.5
        assert valid.any()
        assert (~valid).any(), "no estimate while the jaws are open"
        assert states[valid, names.index("slip.rotation_deg")].abs().max() > 5.0
        assert (states[valid, names.index("slip.sigma_deg")] > 0.0).all()
        assert dataset[0]["observation.images.gel_left"].shape == (3, 320, 240)
