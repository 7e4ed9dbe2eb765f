"""Reloading the configuration: applied as a whole where that is safe, otherwise refused as a whole with the reason."""

from __future__ import annotations

import asyncio
import json
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from loop_cell import Cell, on_cell

from slipguard.cli.run import bind_api
from slipguard.config import Config, parse_config
from slipguard.control.state import Phase
from slipguard.daemon import run as root
from slipguard.daemon.api.requests import ActivateRequest, GraspRequest, GuardRequest, LiftRequest, MoveJawsRequest
from slipguard.daemon.api.snapshot import snapshot
from slipguard.daemon.reload import CurrentGrip, Reloader, current_grip, find_changes, refusal_reason
from slipguard.errors import CommandRefused, ConfigError
from slipguard.sim.world import World, WorldSettings

FAKES: dict[str, Any] = {name: {"driver": "fake", "fake": {"draw": "inline"}} for name in ("left", "right")}


def config(**sections: Any) -> Config:
    return parse_config(FAKES | sections, where="test", sim=True)


def reloader(cell: Cell, read: Callable[[], Config]) -> Reloader:
    return Reloader(cell.service, read, lambda: None)


@pytest.mark.parametrize("phase", Phase)
def test_the_guard_changes_only_while_nothing_moves(phase: Phase) -> None:
    new = config(guard={"tuning": {"slip_rate_deg_s": 3.0}})
    (change,) = find_changes(config(), new)
    rests = phase in (Phase.IDLE, Phase.HOLDING, Phase.FAULT)
    assert refusal_reason(change, new, CurrentGrip(phase, False, 40.0)) == (
        None if rests else f"not possible while {phase.value}"
    )
    assert refusal_reason(change, new, CurrentGrip(Phase.HOLDING, True, 40.0)) == "not possible while the object slips"


@on_cell("wrench", 1)
async def test_thresholds_take_effect_while_an_object_is_held(cell: Cell) -> None:
    await cell.ready()
    await cell.grasp()
    assert await reloader(
        cell, lambda: config(guard={"force_max_n": 115.0, "tuning": {"slip_rate_deg_s": 2.5}})
    ).reload()
    assert cell.service.config.guard.force_max_n == 115.0
    assert cell.service.event_log.lines[-1] == (
        "configuration reloaded: guard.force_max_n: 130.0 -> 115.0, guard.tuning.slip_rate_deg_s: 8.0 -> 2.5"
    )
    await cell.lift()
    assert cell.phase is Phase.HOLDING
    assert cell.gripper.commands
    assert all(value <= 115.0 for _, what, value in cell.gripper.commands if what == "hold")


@on_cell("wrench", 1)
async def test_a_force_limit_below_the_present_grip_is_refused_with_the_whole_file(cell: Cell) -> None:
    await cell.ready()
    await cell.grasp()
    held_n = current_grip(cell.service).force_n
    assert held_n >= 40.0
    low = {
        "force_max_n": 35.0,
        "no_estimate_force_n": 30.0,
        "first_force_n": 20.0,
        "tuning": {"slip_rate_deg_s": 3.0},
    }
    before = cell.service.config
    assert not await reloader(cell, lambda: config(guard=low, recording={"ring_s": 60})).reload()
    assert cell.service.config is before
    line = cell.service.event_log.lines[-1]
    assert line == (
        "configuration not reloaded, the old one stays in use: guard.force_max_n: 130.0 -> 35.0 "
        f"the object is held with {held_n:.0f} N; support it, then release it"
    )
    await cell.release()
    assert await reloader(cell, lambda: config(guard=low)).reload()
    assert cell.service.config.guard.force_max_n == 35.0


@pytest.mark.parametrize("failure", [ConfigError("config.toml: guard.mode = 'x': wrong"), RuntimeError("a driver's")])
@on_cell()
async def test_a_file_that_cannot_be_read_changes_nothing(cell: Cell, failure: Exception) -> None:
    def read() -> Config:
        raise failure

    await cell.ready()
    before = cell.service.config
    assert not await reloader(cell, read).reload()
    assert cell.service.config is before
    assert "the old one stays in use: " in cell.service.event_log.lines[-1]
    assert cell.phase is Phase.IDLE


@on_cell("wrench", 1)
async def test_with_the_last_valid_configuration_nothing_new_is_gripped_or_lifted(cell: Cell) -> None:
    await cell.grasp()
    await cell.lift()
    cell.service.config_problem = "config.toml: guard.forse: no such key. Correct the file"
    for request in (GraspRequest(), LiftRequest(), ActivateRequest(confirm=True), MoveJawsRequest(width_mm=60.0)):
        with pytest.raises(CommandRefused, match=f"cannot {request.kind}: config.toml: guard.forse"):
            await cell.submit(request)
    await cell.submit(GuardRequest(on=True))
    await cell.lower()
    assert cell.phase is Phase.HOLDING
    await cell.release()
    assert await reloader(cell, config).reload()
    await cell.grasp()


def test_sighup_reads_the_file_begins_a_new_recording_and_keeps_the_configuration(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The daemon as it runs, except for its devices."""
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path))
    asked = {"state": {"directory": str(tmp_path)}, "recording": {"ring_s": 60}}
    newer = asked | {"guard": {"force_max_n": 110.0}}
    made: list[float] = []
    reloaded = asyncio.Event()

    async def kept(force_max_n: float) -> None:
        path = tmp_path / "last_config.json"
        while not path.exists() or json.loads(path.read_bytes())["guard"]["force_max_n"] != force_max_n:  # noqa: ASYNC110 - a file
            await asyncio.sleep(0.01)

    async def extra_task_body(service: Any) -> None:
        await kept(130.0)
        assert snapshot(service, {}).config_problem == "the file is not valid"
        os.kill(os.getpid(), signal.SIGHUP)
        await reloaded.wait()
        await kept(110.0)
        assert snapshot(service, {}).config_problem is None
        os.kill(os.getpid(), signal.SIGTERM)
        await asyncio.sleep(60.0)

    def recorder(service: Any, folder: Path) -> Any:
        made.append(service.config.guard.force_max_n)
        if len(made) == 2:
            reloaded.set()
        return root.make_recorder(service, folder)

    async def main() -> None:
        async with asyncio.timeout(30.0):
            await root.run(
                config(**asked),
                bind_api,
                world=World(WorldSettings(), seed=0),
                extra_task=extra_task_body,
                recorder=recorder,
                read_config=lambda: config(**newer),
                config_problem="the file is not valid",
            )

    asyncio.run(main())
    assert made == [130.0, 110.0]
