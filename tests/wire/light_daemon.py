"""The whole daemon as a process of its own, with fake devices whose images cost nothing: API, log, state, recorder.

    python light_daemon.py FOLDER STATE_FOLDER [dead-disk]

Its log goes to stderr, or to the journal at FOLDER/journal if that exists; FOLDER/slipguard.sock is its API. An object
lies between the jaws. dead-disk: a write of the state never ends, and the process waits for it for `DEAD_DISK_EXIT_S`.
"""

from __future__ import annotations

import asyncio
import os
import sys
import threading
from dataclasses import replace
from functools import partial
from pathlib import Path

sys.path += [str(Path(__file__).parents[1] / "loop"), str(Path(__file__).parents[1])]

from loop_cell import Cell

from slipguard.cli.run import bind_api
from slipguard.config import Config, parse_config
from slipguard.daemon import lifecycle, log_setup, run
from slipguard.daemon.journal import JournalOutput
from slipguard.daemon.lifecycle import exit_if_stuck
from slipguard.daemon.loop.service import Service
from slipguard.daemon.store.state_dir import StateDir
from slipguard.sim.scenario import scenario

PATIENT: dict[str, object] = {
    "frames_timeout_s": 2.0,
    "gripper_timeout_s": 2.0,
    "arm_timeout_s": 2.0,
    "cycle_timeout_s": 2.0,
}
"""A test machine may be busy."""


DEAD_DISK_EXIT_S = 3.0


def main(folder: Path, state: Path, *, dead_disk: bool) -> None:
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
    raw |= {"state": {"directory": str(state)}, "api": {"socket": str(folder / "slipguard.sock"), "listen": ""}}
    config = parse_config(raw | {"guard": {"tuning": PATIENT}}, where="test", sim=True)
    cell = Cell("wrench", 1, guard={"tuning": PATIENT}, threads=True, watched=False)
    journal = folder / "journal"
    if journal.exists():
        stderr = os.fstat(sys.stderr.fileno())
        os.environ["JOURNAL_STREAM"] = f"{stderr.st_dev}:{stderr.st_ino}"
        log_setup.JournalOutput = partial(JournalOutput, str(journal))  # type: ignore[assignment,misc]
    log_setup.configure(json_lines=None if journal.exists() else True)
    if dead_disk:
        lifecycle.EXIT_S = DEAD_DISK_EXIT_S
        StateDir.delete_last_grasp = lambda self: threading.Event().wait()  # type: ignore[assignment,method-assign]

    def build(config: Config, world: object) -> Service:
        cell.service.apply_config(config)
        return cell.service

    async def place(service: Service) -> None:
        assert cell.world is not None
        drawn = scenario("wrench", 1)
        cell.world.place(replace(drawn, left=replace(drawn.left, fps=60.0)), asyncio.get_running_loop().time())
        await asyncio.Event().wait()

    asyncio.run(run.run(config, bind_api, build=build, extra_task=place, on_stop=exit_if_stuck))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), dead_disk="dead-disk" in sys.argv)
