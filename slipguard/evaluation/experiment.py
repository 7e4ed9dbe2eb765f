"""An experiment in a folder: protocol, recordings, results and report. Lifts that are recorded are not repeated.

<out>/protocol.json              the protocol; a run continues only with the same one
<out>/lifts/001-bar-1.mcap       the recording of one lift
<out>/lifts/001-bar-1.json       its result, computed again if it is missing or outdated
<out>/report.html, report.json   the report, with PNG figures
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from slipguard.errors import InputError
from slipguard.evaluation.lift_analysis import LiftResult, analyze, result_from_json
from slipguard.evaluation.lift_recording import lift_paths, read_lift
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.evaluation.report_data import report_json
from slipguard.evaluation.report_html import write_page
from slipguard.evaluation.report_plots import draw_curves, draw_errors, draw_masks
from slipguard.evaluation.simulated_lifts import SimulatedLift, record
from slipguard.tools.parallel import Workers, each

PROTOCOL = "protocol.json"
LIFTS = "lifts"
ANALYSIS = 3
"""Version of the analysis: increase it when the same recording yields other figures."""


def prepare(out: Path, protocol: LiftProtocol, *, simulated: bool = False) -> list[PlannedLift]:
    """Create the folder, or check that it holds the same experiment; return the lifts not yet recorded.

    Raises InputError.
    """
    path = out / PROTOCOL
    plan = {"cell": "simulated" if simulated else "real", "protocol": protocol.model_dump(mode="json")}
    wanted = json.dumps(plan, indent=1)
    try:
        (out / LIFTS).mkdir(parents=True, exist_ok=True)
        if path.exists() and path.read_text() != wanted:
            raise InputError(f"{out}: holds another experiment ({PROTOCOL} differs); choose another --out")
        path.write_text(wanted)
    except OSError as error:
        raise InputError(f"{out}: cannot be used ({error.strerror}); choose another --out") from None
    return [lift for lift in protocol.lifts() if not recording_path(out, lift).exists()]


def recording_path(out: Path, lift: PlannedLift) -> Path:
    return out / LIFTS / f"{lift.stem}.mcap"


def run_simulated(
    out: Path, protocol: LiftProtocol, workers: Workers, progress: Callable[[int], None] = lambda done: None
) -> int:
    """Simulate all missing lifts on all cores; return their number."""
    tasks = [
        SimulatedLift(protocol, lift, recording_path(out, lift)) for lift in prepare(out, protocol, simulated=True)
    ]
    for _ in each(_record_and_analyze, tasks, workers, named=lambda task: task.lift.stem, progress=progress):
        pass
    return len(tasks)


def _record_and_analyze(task: SimulatedLift) -> None:
    result_of(record(task))


def result_of(path: Path) -> LiftResult:
    """Return a lift's result: the stored one, or a new one, which is stored. One with a problem is computed again."""
    stored = path.with_suffix(".json")
    if stored.exists() and stored.stat().st_mtime_ns >= path.stat().st_mtime_ns:
        try:
            before = json.loads(stored.read_text())
            if before["analysis"] == ANALYSIS and before["result"]["problem"] is None:
                return result_from_json(before["result"])
        except (ValueError, TypeError, KeyError):
            pass  # of another version, or truncated
    result = analyze(read_lift(path))
    part = stored.with_suffix(".json.part")
    part.write_text(json.dumps({"analysis": ANALYSIS, "result": result.as_json()}))
    part.replace(stored)
    return result


def results(out: Path, workers: Workers, progress: Callable[[int], None] = lambda done: None) -> list[LiftResult]:
    """Return every lift's result, in order. Raises InputError if there are none."""
    paths = list(lift_paths(out))
    if not paths:
        raise InputError(f"{out}: no recordings in {LIFTS}/; run `slipguard evaluate run --out {out}` first")
    return list(each(result_of, paths, workers, named=lambda path: path.stem, progress=progress))


PAGE, FIGURES = "report.html", "report.json"


def write_report(out: Path, workers: Workers, progress: Callable[[int], None] = lambda done: None) -> dict[str, Any]:
    """Write report.html, report.json and the PNGs; return the content of report.json. Raises InputError."""
    lifts = results(out, workers, progress)
    report = report_json(lifts)
    figures = {"errors": out / "errors.png", "curves": out / "curves.png"}
    draw_errors(lifts, figures["errors"])
    draw_curves(lifts, figures["curves"])
    if draw_masks(out / LIFTS, lifts, out / "masks.png"):
        figures["masks"] = out / "masks.png"
    try:
        write_page(out / PAGE, report, _protocol(out), figures)
        (out / FIGURES).write_text(json.dumps(report, indent=1) + "\n")
    except OSError as error:
        raise InputError(f"{out}: the report cannot be written ({error.strerror})") from None
    return report


def _protocol(out: Path) -> LiftProtocol | None:
    """Return the protocol of the experiment, None if the folder has none."""
    try:
        return LiftProtocol.model_validate(json.loads((out / PROTOCOL).read_text())["protocol"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
