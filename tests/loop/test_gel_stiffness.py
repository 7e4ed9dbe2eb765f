"""What the grasps have shown of the gels is kept by serial number, and used again after a start."""

from __future__ import annotations

import asyncio
from pathlib import Path

import numpy as np
from loop_cell import Cell, on_cell

from slipguard.control.load_state import STIFFNESS_PRIOR, LogNormal
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.gel_stiffness import StiffnessSaver, restore_stiffness
from slipguard.daemon.store.state_dir import StateDir

SERIALS = ("D20479", "D20510")
SOFT = LogNormal(0.08, 0.5)
IMAGE = BackgroundImage(np.full((320, 240, 3), 90, np.uint8), (2.9, 1.5, 2.4), 30)


def stored(tmp_path: Path, *known: tuple[str, LogNormal]) -> StateDir:
    state_dir = StateDir(tmp_path)
    for serial, stiffness in known:
        state_dir.save_stiffness(serial, stiffness, state_dir.gel_number(serial))
    return state_dir


@on_cell("wrench", 1)
async def test_what_a_lift_shows_is_stored_for_both_sensors(cell: Cell, tmp_path: Path) -> None:
    state_dir = StateDir(tmp_path)
    saver = StiffnessSaver(state_dir, SERIALS, STIFFNESS_PRIOR, cell.messages.append, cell.messages.append)
    cell.service.observers.append(saver.add_decision)
    await cell.grasp()
    await asyncio.sleep(0.2)
    assert restore_stiffness(state_dir, SERIALS) == STIFFNESS_PRIOR, "nothing has been shown yet"
    assert not (tmp_path / "sensors").exists()
    await cell.lift()
    await asyncio.sleep(2.0)
    learned = cell.service.state.gel
    assert learned != STIFFNESS_PRIOR
    assert restore_stiffness(state_dir, SERIALS) == learned
    assert restore_stiffness(state_dir, SERIALS[::-1]) == learned


def test_a_new_gel_is_unknown_and_another_image_of_the_same_is_not(tmp_path: Path) -> None:
    state_dir = StateDir(tmp_path)
    for serial in SERIALS:
        state_dir.save_background(serial, IMAGE)
    stored(tmp_path, *((serial, SOFT) for serial in SERIALS))
    state_dir.save_background("D20479", IMAGE)
    assert restore_stiffness(state_dir, SERIALS) == SOFT
    state_dir.save_background("D20479", IMAGE, new_gel=True)
    assert restore_stiffness(state_dir, SERIALS) == STIFFNESS_PRIOR


def test_a_damaged_file_is_reported_and_a_serial_number_that_names_no_folder_is_no_obstacle(tmp_path: Path) -> None:
    state_dir, lines = stored(tmp_path, *((serial, SOFT) for serial in SERIALS)), list[str]()
    (tmp_path / "sensors" / "D20479" / "stiffness.json").write_text('{"format": 1, "median_n_m_rad": -1')
    assert restore_stiffness(state_dir, SERIALS, lines.append) == STIFFNESS_PRIOR
    assert restore_stiffness(state_dir, ("a/b", "D20510"), lines.append) == STIFFNESS_PRIOR
    damaged, unfit = lines
    assert damaged.startswith("the learned stiffness of the gels is not used: ")
    assert "damaged" in damaged
    assert "only letters" in unfit
    StiffnessSaver(state_dir, ("a/b", "D20510"), SOFT, lines.append, lines.append)
    assert len(lines) == 2
