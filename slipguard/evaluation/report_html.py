"""The report as one self-contained HTML file."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

from slipguard import __version__
from slipguard.evaluation.protocol import LiftProtocol
from slipguard.evaluation.report_data import PAPER, PAPER_DICE, PAPER_IOU
from slipguard.tools.figures import text as _n

STYLE = """
:root { color-scheme: light dark; --ink: #1d2733; --soft: #5b6672; --line: #d5dbe1; --paper: #ffffff; --band: #f3f5f7; }
@media (prefers-color-scheme: dark) { :root { --ink: #e6eaee; --soft: #a3adb8; --line: #3a444e; --paper: #14191e;
 --band: #1d242b; } figure img { background: #fff; border-radius: 4px; } }
body { margin: 0 auto; max-width: 60rem; padding: 2rem 1.2rem 4rem; color: var(--ink); background: var(--paper);
 font: 16px/1.55 system-ui, sans-serif; }
h1 { font-size: 1.7rem; line-height: 1.2; margin: 0 0 .3rem; } h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
p.lead { color: var(--soft); margin-top: 0; }
.figures { display: grid; grid-template-columns: repeat(auto-fit, minmax(11rem, 1fr)); gap: .8rem; margin: 1.4rem 0; }
.figures div { background: var(--band); border-radius: 6px; padding: .8rem 1rem; }
.figures b { display: block; font-size: 1.55rem; font-variant-numeric: tabular-nums; }
.figures span { color: var(--soft); font-size: .85rem; }
table { border-collapse: collapse; width: 100%; font-size: .9rem; font-variant-numeric: tabular-nums; }
.wide { overflow-x: auto; } caption { text-align: left; color: var(--soft); padding-bottom: .4rem; }
th, td { text-align: right; padding: .3rem .6rem; border-bottom: 1px solid var(--line); white-space: nowrap; }
th:first-child, td:first-child { text-align: left; } thead th { border-bottom: 2px solid var(--ink); }
figure { margin: 1.2rem 0; } figure img { width: 100%; height: auto; }
figcaption { color: var(--soft); font-size: .9rem; }
details { margin: 1rem 0; } summary { cursor: pointer; }
"""


def write_page(path: Path, report: dict[str, Any], protocol: LiftProtocol | None, figures: dict[str, Path]) -> None:
    """Write the page. figures: "errors", "curves", "masks" -> PNG file; missing ones are omitted."""
    parts = [
        f"<h1>{escape(protocol.name if protocol else 'Grasp and lift')}: rotation error against markers</h1>",
        _lead(report, protocol),
        _headline(report),
        _paper_comparison(report),
        _figure(figures, "errors", "Error per object: each dot is the mean of one lift, boxes show quartiles."),
        "<h2>Objects</h2>",
        _object_table(report),
        "<h2>Rotation over time</h2>",
        _figure(figures, "curves", "One lift of each object, the one with the median error."),
        "<h2>Segmentation</h2>" if report["dice"] or "masks" in figures else "",
        _figure(figures, "masks", "Left finger near the end of a lift."),
        "<h2>Ground truth and clocks</h2>",
        _ground_truth(report),
        _problems(report),
        "<h2>Method</h2>",
        _method(protocol),
    ]
    body = "\n".join(part for part in parts if part)
    path.write_text(
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>slipguard: rotation error</title><style>{STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _lead(report: dict[str, Any], protocol: LiftProtocol | None) -> str:
    guard = "guard on" if protocol is not None and protocol.guard else "guard off: rotation is measured, not stopped"
    objects = len(report["per_object"])
    where = "a simulated cell" if report["simulated"] else "a real cell"
    of = f"{objects} object{'s' if objects != 1 else ''}"
    lead = f"{report['lifts']} lifts of {of} on {where}, {guard}. slipguard {__version__}."
    return f"<p class='lead'>{lead}</p>"


def _headline(report: dict[str, Any]) -> str:
    paper = f"{PAPER['turn_error_mean_deg']}° ± {PAPER['turn_error_sd_deg']}°"
    worst = PAPER["turn_error_worst_object_deg"]
    note = _not_comparable(report)
    mean = f"{_mean_sd(report)}°"
    compared = f"mean error over {report['lifts_compared']} lifts; paper, real cell: {paper}{note}"
    sigmas = f"{_percent(report['within_1_sigma'])} / {_percent(report['within_2_sigma'])}"
    tiles = [
        (mean, compared),
        (f"{_n(report['turn_error_worst_object_deg'])}°", f"worst object; paper, real cell: about {worst:g}°{note}"),
        (_percent(report["declined_share"]), "of the time without an estimate"),
        (sigmas, "of errors within 1 / 2 estimated sigmas"),
    ]
    shown = "".join(f"<div><b>{figure}</b><span>{text}</span></div>" for figure, text in tiles)
    return f"<div class='figures'>{shown}</div>"


def _not_comparable(report: dict[str, Any]) -> str:
    """Return the note that belongs next to each of the paper's figures; "" for a real cell."""
    return " (this cell is simulated; not comparable)" if report["simulated"] else ""


def _paper_comparison(report: dict[str, Any]) -> str:
    paper = report["paper_real_cell_as_published"]
    rows = [
        [
            "rotation error, ° (mean ± sd)",
            _mean_sd(report),
            f"{paper['turn_error_mean_deg']} ± {paper['turn_error_sd_deg']}",
        ],
        [
            "worst object, °",
            _n(report["turn_error_worst_object_deg"]),
            f"about {paper['turn_error_worst_object_deg']:g}",
        ],
        ["lifts compared", report["lifts_compared"], "45"],
        ["round contacts", "registered by texture, or declined", "no estimate"],
    ]
    if report["dice"]:
        rows.append(["Dice", _pm(report["dice"], 3), "{} ± {}".format(*PAPER_DICE)])
        rows.append(["IoU", _pm(report["iou"], 3), "{} ± {}".format(*PAPER_IOU)])
    return _table(
        ["", "simulated cell" if report["simulated"] else "this cell", f"paper, real cell{_not_comparable(report)}"],
        rows,
        "Comparison with the paper.",
    )


def _mean_sd(report: dict[str, Any]) -> str:
    return f"{_n(report['turn_error_mean_deg'])} ± {_n(report['turn_error_sd_deg'])}"


def _object_table(report: dict[str, Any]) -> str:
    rows = []
    for name, one in report["per_object"].items():
        fused = one["fused"]
        about = "seen" if one["seen"] else "unseen"
        about += f", {escape(one['hard'])}" if one["hard"] else ""
        rotations = one["turns_deg"]
        span = f"{min(rotations, key=abs):.0f} … {max(rotations, key=abs):.0f}" if rotations else "–"
        rows.append(
            [name.replace("_", " "), about, fused["n"], span, _pm(fused), _n(fused["worst"]),
             _interval(fused), _percent(one["declined_share"])]
        )  # fmt: skip
    for label, key in (
        ("all unseen", "unseen"),
        ("all seen", "seen"),
        ("difficult", "hard"),
        ("all others", "without_hard"),
    ):
        one = report[key]
        rows.append([f"<i>{label}</i>", "", one["n"], "", _pm(one), _n(one["worst"]),
                     _interval(one), ""])  # fmt: skip
    head = ["object", "", "lifts", "rotation, °", "error, ° (mean ± sd)", "worst lift", "95 % interval of the mean",
            "declined"]  # fmt: skip
    return _table(head, rows, "Mean over the frames of a lift, then over lifts.")


def _ground_truth(report: dict[str, Any]) -> str:
    lags = list(report["lag_ms"].values())
    text = f"In {report['camera_gaps']} images a marker was not found; nothing is compared in these gaps. "
    if lags:
        text += (
            f"The camera's time stamps lag the tactile ones by {min(lags):.0f} to {max(lags):.0f} ms. The lag is "
            "estimated per lift from both rotations and removed, together with any delay of slipguard's own times; "
            f"without this correction the mean error would be {_n(report['turn_error_with_the_lag_left_in_deg'])}°. "
        )
    if report["lag_unknown"]:
        text += f"In {len(report['lag_unknown'])} lifts it could not be determined and is not removed. "
    if report["lag_error_frames"] is not None:
        text += f"In simulation the lag is known; it was recovered within {report['lag_error_frames']:.2f} frames. "
    if report["aruco_error_mean_deg"] is not None:
        text += (
            f"The error of the markers themselves against the simulated truth is {report['aruco_error_mean_deg']:.3f}° "
            f"on average, {report['aruco_error_worst_deg']:.2f}° at most."
        )
    return f"<p>{text}</p>"


def _problems(report: dict[str, Any]) -> str:
    if not report["problems"]:
        return ""
    items = "".join(f"<li>{escape(stem)}: {escape(why)}</li>" for stem, why in report["problems"].items())
    count = len(report["problems"])
    return f"<details open><summary>{count} lifts could not be compared</summary><ul>{items}</ul></details>"


def _method(protocol: LiftProtocol | None) -> str:
    lifted = ""
    if protocol is not None:
        low, high = protocol.rotation_deg
        lifted = (
            f"Every object is gripped and lifted {protocol.repeats} times at {protocol.lift_speed_mm_s:g} mm/s and "
            f"rotates by {low:g}° to {high:g}°. "
        )
    return (
        f"<p>{lifted}One marker is on the gripper, one on the object; the rotation about the grasp axis is fitted to "
        "the corners in all images of a lift. Both rotations are zero when slipguard takes its reference, with the "
        "object at rest. The error is slipguard's estimate at a tactile frame's capture time minus the markers' "
        "rotation; the error of a lift is the mean of the absolute errors. Intervals are bootstrapped over lifts. "
        "“Paper”: Castaño-Amorós &amp; Gil, real cell; results of a simulated cell are not comparable with it.</p>"
    )


def _figure(figures: dict[str, Path], name: str, caption: str) -> str:
    if name not in figures:
        return ""
    content = base64.b64encode(figures[name].read_bytes()).decode()
    image = f"<img alt='{caption}' src='data:image/png;base64,{content}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _table(head: list[str], rows: list[list[Any]], caption: str) -> str:
    top = "".join(f"<th scope='col'>{text}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><caption>{caption}</caption><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div class='wide'>{table}</div>"


def _interval(one: dict[str, Any]) -> str:
    return "–" if one["low"] is None else f"{one['low']:.2f} – {one['high']:.2f}"


def _pm(one: dict[str, Any], digits: int = 2) -> str:
    return "–" if one["mean"] is None else f"{one['mean']:.{digits}f} ± {one['sd']:.{digits}f}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"
