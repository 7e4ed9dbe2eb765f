"""The whole daemon as a process of its own, with fake devices whose images cost nothing: API, log, state, recorder.

    python light_daemon.py FOLDER STATE_FOLDER [dead-disk] [guard-mode]

Its log goes to stderr, or to the journal at FOLDER/journal if that exists; FOLDER/slipguard.sock is its API. An object
lies between the jaws. guard-mode: another program moves the arm. dead-disk: a write of the state never ends, and the
process waits for it for `DEAD_DISK_EXIT_S`. The wall clock of the process is ahead by the seconds in
FOLDER/clock, which may change at any time.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import sys
import threading
import time
from dataclasses import replace
from datetime import datetime, timezone, tzinfo
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import structlog

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
CLOCK_READ_S = 0.05


class SettableClock:
    """The wall clock of this process, which `set_ahead` sets like an operator or NTP. The monotonic clock goes on."""

    def __init__(self) -> None:
        self.ahead_s, now_s, now_ns, clock = 0.0, time.time, time.time_ns, self

        class SetDatetime(datetime):
            @classmethod
            def now(cls, tz: tzinfo | None = None) -> datetime:  # type: ignore[override]
                return datetime.fromtimestamp(time.time(), tz)

        time.time = lambda: now_s() + clock.ahead_s
        time.time_ns = lambda: now_ns() + round(1e9 * clock.ahead_s)
        for module in [*sys.modules.values()]:
            if module.__name__.startswith("slipguard") and getattr(module, "datetime", None) is datetime:
                module.datetime = SetDatetime  # type: ignore[attr-defined]
        structlog.processors.datetime = SimpleNamespace(  # type: ignore[assignment]
            datetime=SetDatetime, timezone=timezone
        )

    async def follow(self, file: Path) -> None:
        """Follow what the file says, until cancelled."""
        while True:
            with contextlib.suppress(OSError, ValueError):
                self.ahead_s = float(file.read_text())  # noqa: ASYNC240 - a small file of a test
            await asyncio.sleep(CLOCK_READ_S)


def main(folder: Path, state: Path, *, dead_disk: bool, mode: str) -> None:
    raw: dict[str, object] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}
    raw |= {"state": {"directory": str(state)}, "api": {"socket": str(folder / "slipguard.sock"), "listen": ""}}
    guard = {"mode": mode, "tuning": PATIENT}
    config = parse_config(raw | {"guard": guard}, where="test", sim=True)
    cell = Cell("wrench", 1, guard=guard, threads=True, watched=False)
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
        await clock.follow(folder / "clock")

    clock = SettableClock()
    asyncio.run(run.run(config, bind_api, build=build, extra_task=place, on_stop=exit_if_stuck))


if __name__ == "__main__":
    guard_mode = "guard-mode" in sys.argv
    main(
        Path(sys.argv[1]), Path(sys.argv[2]), dead_disk="dead-disk" in sys.argv, mode="guard" if guard_mode else "lift"
    )
