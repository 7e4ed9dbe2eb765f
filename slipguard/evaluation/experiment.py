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
from slipguard.tools.experiment import Case, ResultStore, run_cases
from slipguard.tools.figures import write_json
from slipguard.tools.parallel import Workers

PROTOCOL = "protocol.json"
LIFTS = "lifts"
ANALYSIS = 4
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
    out: Path, protocol: LiftProtocol, workers: Workers, progress: Callable[[float], None] = lambda share: None
) -> None:
    """Simulate and analyze all missing lifts on all cores."""
    planned = prepare(out, protocol, simulated=True)
    cases = [
        Case(lift.stem, protocol.seed + lift.number, SimulatedLift(protocol, lift, recording_path(out, lift)))
        for lift in planned
    ]
    for _ in run_cases(_record_and_analyze, cases, workers, named=Case.title, progress=progress):
        pass


def _record_and_analyze(case: Case[SimulatedLift]) -> LiftResult:
    return result_of(record(case.parameters))


_RESULTS = ResultStore(ANALYSIS, LiftResult.as_json, result_from_json)


def result_of(path: Path) -> LiftResult:
    """Return a lift's result: the stored one, or a new one, which is stored. One with a problem is computed again."""
    return _RESULTS.result(path, lambda source: analyze(read_lift(source)), keep=lambda result: result.problem is None)


def _analyze(case: Case[Path]) -> LiftResult:
    return result_of(case.parameters)


def results(out: Path, workers: Workers, progress: Callable[[float], None] = lambda share: None) -> list[LiftResult]:
    """Return every lift's result, in order. Raises InputError if there are none."""
    cases = [Case(path.stem, 0, path) for path in lift_paths(out)]
    if not cases:
        raise InputError(f"{out}: no recordings in {LIFTS}/; run `slipguard evaluate run --out {out}` first")
    return [result for _, result in run_cases(_analyze, cases, workers, named=Case.title, progress=progress)]


PAGE, FIGURES = "report.html", "report.json"


def write_report(out: Path, workers: Workers, progress: Callable[[float], None] = lambda share: None) -> dict[str, Any]:
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
    except OSError as error:
        raise InputError(f"{out}: the report cannot be written ({error.strerror})") from None
    write_json(out / FIGURES, report)
    return report


def _protocol(out: Path) -> LiftProtocol | None:
    """Return the protocol of the experiment, None if the folder has none."""
    try:
        return LiftProtocol.model_validate(json.loads((out / PROTOCOL).read_text())["protocol"])
    except (OSError, ValueError, KeyError, TypeError):
        return None
