"""A damaged state directory never stops the daemon: the finger runs, and a calibration repairs it."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import structlog
from command_line import slipguard

from slipguard.config import parse_config
from slipguard.daemon.loop.finger import Finger
from slipguard.daemon.run import build_service
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import Frame
from slipguard.sim.world import World


def cut_short(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:100])


def emptied(path: Path) -> None:
    path.write_bytes(b"")


def made_a_folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def removed(path: Path) -> None:
    path.unlink()


@pytest.mark.parametrize("ending", ["png", "json"])
@pytest.mark.parametrize("damage", [cut_short, emptied, made_a_folder, removed])
def test_the_finger_runs_without_its_damaged_image(
    damage: Callable[[Path], None], ending: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    state = StateDir(tmp_path)
    rng = np.random.default_rng(0)
    image = np.clip(rng.normal(100.0, 2.0, (320, 240, 3)), 0, 255).astype(np.uint8)
    state.save_background("SIM-L", BackgroundImage(image, (2.0, 2.0, 2.0), 30))
    (stored,) = tmp_path.rglob(f"*.{ending}")
    damage(stored)
    structlog.reset_defaults()  # a test before this one may have silenced the log
    config = parse_config({"state": {"directory": str(tmp_path)}}, where="test", sim=True)
    service = build_service(config, world=World(seed=0))
    try:
        finger = service.fingers["left"]
        finger.capture.assume_serial("SIM-L")
        asyncio.run(_renew(finger))
        assert finger.pipeline is not None
        finger.pipeline.process(Frame(image, 0.0, 0))
    finally:
        service.close()
        structlog.reset_defaults()
    output = capfd.readouterr()
    assert "Traceback" not in output.out + output.err
    if not (damage is removed and ending == "json"):
        assert "no_contact-0001" in output.out + output.err
    state.save_background("SIM-L", BackgroundImage(image, (2.0, 2.0, 2.0), 30))
    again = state.load_background("SIM-L")
    assert again is not None
    assert np.array_equal(again.image, image)


async def _renew(finger: Finger) -> None:
    finger.renew_pipeline()


def test_a_state_directory_that_is_a_file_ends_the_start_with_one_line(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    with tempfile.TemporaryDirectory(prefix="sg") as short:  # a Unix socket's path has at most 107 bytes
        state, config = Path(short) / "state", Path(short) / "cell.toml"
        state.write_text("")
        config.write_text(f'[state]\ndirectory = "{state}"\n')
        monkeypatch.setenv("HOME", short)
        ran = slipguard(capfd, "run", "--sim", "--config", config)
        last = ran.err.strip().splitlines()[-1]  # after warnings about what could not be read
        assert last.startswith("slipguard: the API's socket")
        assert str(state) in last
        assert ran.code == 2
