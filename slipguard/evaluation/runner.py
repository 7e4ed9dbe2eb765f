"""An experiment in a folder: its protocol, one recording and one result a lift; what is there is not done again.

<out>/protocol.json              what was asked for; a run goes on only with the same
<out>/lifts/001-bar-1.mcap       everything that was seen and done
<out>/lifts/001-bar-1.json       what it came to (made anew where it is missing)
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

from slipguard.errors import InputError
from slipguard.evaluation.analyse import LiftResult, analyse, result_from_json
from slipguard.evaluation.lift_data import lift_paths, read_lift
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.evaluation.simulated import SimulatedLift, record
from slipguard.tools.parallel import Workers, each

PROTOCOL = "protocol.json"
LIFTS = "lifts"
ANALYSIS = 2
"""Counts up when the same recording would come to other figures."""


def prepare(out: Path, protocol: LiftProtocol, *, simulated: bool = False) -> list[PlannedLift]:
    """Make the folder, or check that it holds this very experiment; returns the lifts that are still to be done.

    Raises InputError.
    """
    path = out / PROTOCOL
    plan = {"cell": "simulated" if simulated else "real", "protocol": protocol.model_dump(mode="json")}
    wanted = json.dumps(plan, indent=1)
    try:
        (out / LIFTS).mkdir(parents=True, exist_ok=True)
        if path.exists() and path.read_text() != wanted:
            raise InputError(f"{out}: holds another experiment ({PROTOCOL} differs); give another --out")
        path.write_text(wanted)
    except OSError as error:
        raise InputError(f"{out}: cannot be used ({error.strerror}); give another --out") from None
    return [lift for lift in protocol.lifts() if not recording_path(out, lift).exists()]


def recording_path(out: Path, lift: PlannedLift) -> Path:
    """Where a lift's recording lies."""
    return out / LIFTS / f"{lift.stem}.mcap"


def run_simulated(
    out: Path, protocol: LiftProtocol, workers: Workers, progress: Callable[[int], None] = lambda done: None
) -> int:
    """Do all lifts that are still missing, on all cores; returns how many that were."""
    tasks = [
        SimulatedLift(protocol, lift, recording_path(out, lift)) for lift in prepare(out, protocol, simulated=True)
    ]
    for _ in each(_record_and_analyse, tasks, workers, named=lambda task: task.lift.stem, progress=progress):
        pass
    return len(tasks)


def _record_and_analyse(task: SimulatedLift) -> None:
    result_of(record(task))


def result_of(path: Path) -> LiftResult:
    """A lift's result: as kept beside its recording, or made now and kept. One with a problem is tried again."""
    kept = path.with_suffix(".json")
    if kept.exists() and kept.stat().st_mtime_ns >= path.stat().st_mtime_ns:
        try:
            before = json.loads(kept.read_text())
            if before["analysis"] == ANALYSIS and before["result"]["problem"] is None:
                return result_from_json(before["result"])
        except (ValueError, TypeError, KeyError):
            pass  # of another version, or cut off: made anew
    result = analyse(read_lift(path))
    part = kept.with_suffix(".json.part")
    part.write_text(json.dumps({"analysis": ANALYSIS, "result": result.as_json()}))
    part.replace(kept)
    return result


def results(out: Path, workers: Workers, progress: Callable[[int], None] = lambda done: None) -> list[LiftResult]:
    """Every lift's result, in order. Raises InputError where there are none."""
    paths = list(lift_paths(out))
    if not paths:
        raise InputError(f"{out}: no recordings in {LIFTS}/; run `slipguard evaluate run --out {out}` first")
    return list(each(result_of, paths, workers, named=lambda path: path.stem, progress=progress))
