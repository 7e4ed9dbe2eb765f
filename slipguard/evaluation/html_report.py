"""The report as one HTML file that needs nothing beside it."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

from slipguard import __version__
from slipguard.evaluation.protocol import LiftProtocol
from slipguard.evaluation.summary import ESTIMATORS, PAPER, PAPER_DICE, PAPER_IOU

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


def write_page(path: Path, report: dict[str, Any], protocol: LiftProtocol | None, pictures: dict[str, Path]) -> None:
    """Write the page. pictures: "errors", "curves", "masks" -> PNG file; those not there are left out."""
    parts = [
        f"<h1>{escape(protocol.name if protocol else 'Grasp and lift')}: rotation error against markers</h1>",
        _lead(report, protocol),
        _headline(report),
        _beside_the_paper(report),
        _picture(pictures, "errors", "Error per object: each dot is the mean of one lift, boxes their quartiles."),
        "<h2>Objects</h2>",
        _object_table(report),
        "<h2>Estimators</h2>",
        _estimator_table(report),
        "<h2>Turn over time</h2>",
        _picture(pictures, "curves", "One lift of each object, the one whose error is its median."),
        "<h2>Segmentation</h2>" if report["dice"] or "masks" in pictures else "",
        _picture(pictures, "masks", "Left finger near the end of a lift."),
        _network_table(report),
        "<h2>Ground truth and time</h2>",
        _ground(report),
        _problems(report),
        "<h2>How it was done</h2>",
        _method(protocol),
    ]
    body = "\n".join(part for part in parts if part)
    path.write_text(
        "<!doctype html>\n<html lang='en'><head><meta charset='utf-8'>"
        "<meta name='viewport' content='width=device-width, initial-scale=1'>"
        f"<title>slipguard: rotation error</title><style>{STYLE}</style></head><body>\n{body}\n</body></html>\n"
    )


def _lead(report: dict[str, Any], protocol: LiftProtocol | None) -> str:
    guard = (
        "with the guard" if protocol is not None and protocol.guard else "guard off: the turn is measured, not stopped"
    )
    objects = len(report["per_object"])
    where = "a simulated cell" if report["simulated"] else "a real cell"
    lead = f"{report['lifts']} lifts of {objects} objects on {where}, {guard}. slipguard {__version__}."
    return f"<p class='lead'>{lead}</p>"


def _headline(report: dict[str, Any]) -> str:
    paper, worst = (
        f"{PAPER['turn_error_mean_deg']}° ± {PAPER['turn_error_sd_deg']}°",
        PAPER["turn_error_worst_object_deg"],
    )
    mean = f"{_mean_sd(report)}°"
    compared = f"mean error over {report['lifts_compared']} lifts; real cell, as published: {paper}"
    sigmas = f"{_percent(report['within_1_sigma'])} / {_percent(report['within_2_sigma'])}"
    tiles = [
        (mean, compared),
        (f"{_n(report['turn_error_worst_object_deg'])}°", f"worst object; as published: about {worst:g}°"),
        (_percent(report["declined_share"]), "of the time no turn was told"),
        (sigmas, "of errors within 1 / 2 of the stated sigmas"),
    ]
    shown = "".join(f"<div><b>{figure}</b><span>{text}</span></div>" for figure, text in tiles)
    return f"<div class='figures'>{shown}</div>"


def _beside_the_paper(report: dict[str, Any]) -> str:
    paper = report["paper_real_cell_as_published"]
    skeleton = report["per_estimator"]["skeleton"]
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
        ["the paper's estimator (skeleton) here, °", _pm(skeleton), "as above"],
        ["lifts compared", report["lifts_compared"], "45"],
        ["round contacts", "registered by relief, or declined", "no answer"],
    ]
    if report["dice"]:
        rows.append(["Dice", _pm(report["dice"], 3), "{} ± {}".format(*PAPER_DICE)])
        rows.append(["IoU", _pm(report["iou"], 3), "{} ± {}".format(*PAPER_IOU)])
    return _table(["", "here", "real cell, as published"], rows, "Beside the paper.")


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
        ("heavy and saturating", "hard"),
        ("all others", "without_hard"),
    ):
        one = report[key]
        rows.append([f"<i>{label}</i>", "", one["n"], "", _pm(one), _n(one["worst"]),
                     _interval(one), ""])  # fmt: skip
    head = ["object", "", "lifts", "turns, °", "error, ° (mean ± sd)", "worst lift", "95 % interval of the mean",
            "not told"]  # fmt: skip
    return _table(head, rows, "Mean over the frames of a lift, then over lifts.")


def _estimator_table(report: dict[str, Any]) -> str:
    rows = []
    for name in ESTIMATORS:
        one = report["per_estimator"][name]
        told = "fused (what the guard goes by)" if name == "fused" else name
        rows.append([told, one["n"], _pm(one), _n(one["worst"]), _interval(one)])
    rows.append(["<i>skeleton, real cell, as published</i>", 45,
                 f"{PAPER['turn_error_mean_deg']} ± {PAPER['turn_error_sd_deg']}", "", ""])  # fmt: skip
    head = ["estimator", "lifts told", "error, ° (mean ± sd)", "worst lift", "95 % interval of the mean"]
    return _table(head, rows, "Where an estimator declines there is no error, so compare the lifts told too.")


def _network_table(report: dict[str, Any]) -> str:
    if not report["networks"]:
        return ""
    rows = [
        [escape(one["network"]), one["n"], _pm(one["dice"], 3), _pm(one["iou"], 3), _n(one["ms_median"], 1)]
        for one in report["networks"]
    ]
    return _table(
        ["network", "n", "Dice", "IoU", "ms, median, one core"], rows, "The same frames through each network."
    )


def _ground(report: dict[str, Any]) -> str:
    lags = list(report["lag_ms"].values())
    text = f"In {report['camera_gaps']} pictures a marker was not seen well: gaps, in which nothing is compared. "
    if lags:
        text += (
            f"Its time stamps lag the tactile ones by {min(lags):.0f} to {max(lags):.0f} ms, found lift by lift from "
            "the two turns and taken out (with it goes whatever delay slipguard's own times have); left in, the mean "
            "error would be "
            f"{_n(report['turn_error_with_the_lag_left_in_deg'])}°. "
        )
    if report["lag_unknown"]:
        text += f"In {len(report['lag_unknown'])} lifts it could not be told and is left in. "
    if report["lag_error_frames"] is not None:
        text += f"The lag was known here and was recovered within {report['lag_error_frames']:.2f} frames. "
    if report["aruco_error_mean_deg"] is not None:
        text += (
            f"The markers themselves are off by {report['aruco_error_mean_deg']:.3f}° on average, "
            f"{report['aruco_error_worst_deg']:.2f}° at worst, against the simulated truth."
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
            f"Every object is gripped and lifted {protocol.repeats} times at {protocol.lift_speed_mm_s:g} mm/s, so "
            f"that it turns by {low:g}° to {high:g}°. "
        )
    return (
        f"<p>{lifted}One marker is on the gripper, one on the object; the turn about the grasp axis is fitted to the "
        "corners of all pictures of a lift at once. Both turns are zero where slipguard took its reference, the object "
        "at rest. An error is what slipguard said at a tactile frame's capture time minus what the markers say then; a "
        "lift's error is the mean of its magnitudes. Intervals are bootstrapped over lifts. “As published”: "
        "Castaño-Amorós &amp; Gil, a real cell; figures of a simulated cell do not compare with them one to one.</p>"
    )


def _picture(pictures: dict[str, Path], name: str, caption: str) -> str:
    if name not in pictures:
        return ""
    content = base64.b64encode(pictures[name].read_bytes()).decode()
    image = f"<img alt='{caption}' src='data:image/png;base64,{content}'>"
    return f"<figure>{image}<figcaption>{caption}</figcaption></figure>"


def _table(head: list[str], rows: list[list[Any]], caption: str) -> str:
    top = "".join(f"<th scope='col'>{text}</th>" for text in head)
    body = "".join("<tr>" + "".join(f"<td>{cell}</td>" for cell in row) + "</tr>" for row in rows)
    table = f"<table><caption>{caption}</caption><thead><tr>{top}</tr></thead><tbody>{body}</tbody></table>"
    return f"<div class='wide'>{table}</div>"


def _n(value: float | None, digits: int = 2) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def _interval(one: dict[str, Any]) -> str:
    return "–" if one["low"] is None else f"{one['low']:.2f} – {one['high']:.2f}"


def _pm(one: dict[str, Any], digits: int = 2) -> str:
    return "–" if one["mean"] is None else f"{one['mean']:.{digits}f} ± {one['sd']:.{digits}f}"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100 * share:.0f} %"
