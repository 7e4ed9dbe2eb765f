"""`python -m tests.campaigns torn-frames`: detection, false alarms, angle errors and lifts with torn frames."""

from __future__ import annotations

import json as jsonlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from itertools import chain, pairwise, product
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from slipguard.perception.torn_frame import find_tear
from slipguard.sim.catalogue import object_names
from tests.campaigns.torn.angle_errors import angle_errors
from tests.campaigns.torn.closed_loop import LIFT_KINDS, torn_lift
from tests.campaigns.torn.splices import (
    ALONG,
    EDGES_LEVELS,
    SpliceResult,
    half_size,
    real_captures,
    real_good_pairs,
    rendered_captures,
    rendered_good_pairs,
    rotated_real_captures,
    splice_results,
)

SHARES = (0.0, 0.05, 0.4)
TORN_SHARE = 0.25
"""Share of torn frames for the angle errors."""
CLEAR, CLEAR_SHARE_MIN, CLEAR_COUNT_MIN = ">10", 0.9, 50
"""Class of difference in which tears must be found, how many, and of how many at least. Tears in the outer four lines
cannot be found."""
BANDS, VISIBLE_LEVELS = 8, 4.0
"""Bands of lines by which detection is counted, of tears whose captures differ by this much at the line."""
ERROR_MAX_DEG = 3.0
"""Largest accepted error of an undetected torn frame: less than its grasps rotate in one frame (5 degrees)."""


def torn_frames(
    real: Annotated[Path | None, typer.Option(help="Folder of real DIGIT frames (real_digit).")] = None,
    units: Annotated[int, typer.Option(min=1, help="Rendered sensor units.")] = 6,
    every: Annotated[int, typer.Option(min=1, help="Splice at every n-th row and column.")] = 1,
    lifts: Annotated[int, typer.Option(min=0, help="Objects lifted at 0, 5 and 40 % torn frames.")] = 10,
    seeds: Annotated[int, typer.Option(min=1, help="Grasps of each object.")] = 1,
    json: Annotated[bool, typer.Option("--json", help="Print one JSON object.")] = False,
) -> None:
    """Splice frames at every line: detected tears, false alarms, angle errors, lifts. Exit 1 if a limit is exceeded.

    Example: `python -m tests.campaigns torn-frames --real real_digit`
    """
    found = campaign_figures(real, units, every, lifts, seeds)
    failures = violations(found)
    print(jsonlib.dumps(found | {"failures": failures}) if json else "\n".join([*_lines(found), *failures]))
    if failures:
        raise typer.Exit(1)


def campaign_figures(real: Path | None, units: int, every: int, lifts: int, seeds: int) -> dict[str, Any]:
    """Return all figures as a JSON object."""
    captures = rendered_captures(units)
    pairs = rendered_good_pairs(20 * units, seed=1)
    if real is not None:
        captures = chain(captures, real_captures(real, 20 * units), rotated_real_captures(real, 10 * units))
        pairs = chain(pairs, real_good_pairs(real))
    names = object_names("test")
    splices = list(chain.from_iterable(splice_results(one, every) for one in captures))
    return {
        "detection": detection_table(splices),
        "detection_by_line": detection_by_line(splices),
        "false_alarms": false_alarms(pairs),
        "angle_errors": angle_errors(names[: 2 * units], TORN_SHARE, seeds=max(units // 5, 1)).as_json(),
        "lifts": [
            torn_lift(name, kind, share, seed).as_json()
            for seed in range(seeds)
            for name in names[:lifts]
            for kind in LIFT_KINDS
            for share in SHARES
        ],
    }


def detection_table(results: Iterable[SpliceResult]) -> dict[str, dict[str, list[float]]]:
    """Return by kind and class of difference: [detected share, share at the right line, number]."""
    classes: dict[str, dict[str, list[tuple[bool, bool]]]] = defaultdict(lambda: defaultdict(list))
    names = [f"{low:g}-{high:g}" if high < EDGES_LEVELS[-1] else f">{low:g}" for low, high in pairwise(EDGES_LEVELS)]
    for one in results:
        name = names[int(np.searchsorted(EDGES_LEVELS, one.levels, side="right")) - 1]
        classes[one.kind][name].append((one.found, one.at_line))
    return {
        kind: {
            name: [*(round(float(share), 4) for share in np.mean(of[name], axis=0)), len(of[name])]
            for name in names
            if name in of
        }
        for kind, of in classes.items()
    }


def detection_by_line(splices: Iterable[SpliceResult]) -> dict[str, dict[str, list[list[float]]]]:
    """Return by kind, rows or columns, and band of lines: [detected share, number], of visible tears."""
    bands: dict[str, dict[str, list[list[bool]]]] = defaultdict(
        lambda: {along: [[] for _ in range(BANDS)] for along in ALONG}
    )
    for one in splices:
        if one.levels > VISIBLE_LEVELS:
            bands[one.kind][one.along][int(one.line * BANDS)].append(one.found)
    return {
        kind: {
            along: [[round(float(np.mean(band)), 3) if band else 0.0, len(band)] for band in of]
            for along, of in both.items()
        }
        for kind, both in bands.items()
    }


def false_alarms(pairs: Iterable[tuple[str, NDArray[np.uint8], NDArray[np.uint8]]]) -> dict[str, list[int]]:
    """Return by kind: [good frames that were taken for torn, all], at full and at half size."""
    counts: dict[str, list[int]] = defaultdict(lambda: [0, 0])
    for kind, before, image in pairs:
        sizes = (("240x320", before, image), ("120x160", half_size(before), half_size(image)))
        for size, was, now in sizes:
            count = counts[f"{kind}, {size}"]
            count[0] += find_tear(now, was) is not None
            count[1] += 1
    return dict(counts)


def violations(found: dict[str, Any]) -> list[str]:
    """Return which limits are exceeded, one line each."""
    alarms, detection, errors, lifts = (found[key] for key in ("false_alarms", "detection", "angle_errors", "lifts"))
    lines = [f"{kind}: {bad} of {count} good frames taken for torn" for kind, (bad, count) in alarms.items() if bad]
    for kind, of in detection.items():
        share, _, count = of.get(CLEAR, (1.0, 1.0, 0))
        if count >= CLEAR_COUNT_MIN and share < CLEAR_SHARE_MIN:
            lines.append(f"{kind}, {CLEAR}: {share:.1%} found (limit {CLEAR_SHARE_MIN:.0%})")
    if errors["false"] or errors["undetected_max_deg"] > ERROR_MAX_DEG:
        lines.append(f"angle errors: {errors}")
    for lift in lifts:
        key = [lift[name] for name in ("object_name", "kind", "seed")]
        alone = next(
            one
            for one in lifts
            if one["share"] == 0.0 and [one[name] for name in ("object_name", "kind", "seed")] == key
        )
        tightened = lift["kind"] == "firm" and lift["tightenings"] > alone["tightenings"]
        if lift["outcome"] != "held" or lift["causeless"] > alone["causeless"] or tightened:
            lines.append(f"lift: {lift}; without tears: {alone}")
    return lines


def _lines(found: dict[str, Any]) -> Iterator[str]:
    yield "detected share (number) by difference of the captures at the line, gray levels rms:"
    for kind, of in found["detection"].items():
        yield f"  {kind}: " + ", ".join(f"{name}: {share:.1%} ({count})" for name, (share, _, count) in of.items())
    yield f"the same above {VISIBLE_LEVELS:g} levels, by the line of the tear, in {BANDS} bands from first to last:"
    for kind, both in found["detection_by_line"].items():
        for along, bands in both.items():
            yield f"  {kind}, {along}s: " + ", ".join(f"{share:.0%} ({count})" for share, count in bands)
    yield "good frames taken for torn:"
    yield from (f"  {kind}: {bad} of {count}" for kind, (bad, count) in found["false_alarms"].items())
    yield f"angle errors with {TORN_SHARE:.0%} torn: {found['angle_errors']}"
    yield from lift_lines(found["lifts"])


def lift_lines(lifts: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the sums over all objects by kind of lift and share of torn frames, and then every lift."""
    for kind, share in product(LIFT_KINDS, SHARES):
        of = [one for one in lifts if (one["kind"], one["share"]) == (kind, share)]
        sums = ", ".join(
            f"{sum(one[name] for one in of)} {name}" for name in ("tightenings", "causeless", "torn", "restarts")
        )
        held = sum(one["outcome"] == "held" for one in of)
        yield f"{kind}, {share:.0%} torn: {held} of {len(of)} held, {sums}"
    yield from (str(lift) for lift in lifts)
