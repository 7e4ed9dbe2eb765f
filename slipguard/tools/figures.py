"""Figures of samples, and their tables and JSON: the same for every experiment."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, is_dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich import box
from rich.table import Table

from slipguard.errors import InputError


@dataclass(frozen=True, slots=True)
class Figures:
    """Statistics of a sample; None where it is too small. sd: of a sample of at least two."""

    count: int = 0
    mean: float | None = None
    sd: float | None = None
    p50: float | None = None
    p95: float | None = None
    p99: float | None = None
    worst: float | None = None

    @classmethod
    def of(cls, values: Iterable[float]) -> Figures:
        """Return the figures of some values.

        >>> figures = Figures.of([1.0, 2.0, 3.0])
        >>> figures.count, figures.mean, figures.worst
        (3, 2.0, 3.0)
        """
        sample = np.fromiter(values, np.float64)
        if not sample.size:
            return cls()
        sd = float(sample.std(ddof=1)) if sample.size > 1 else 0.0
        p50, p95, p99 = (float(value) for value in np.quantile(sample, (0.5, 0.95, 0.99)))
        return cls(sample.size, float(sample.mean()), sd, p50, p95, p99, float(sample.max()))


def share(values: Iterable[bool]) -> float | None:
    """Return the share of true values; None without values."""
    return Figures.of(map(float, values)).mean


def percentiles_ms(times_s: Sequence[float] | NDArray[np.float64]) -> tuple[float, float]:
    """Return p50 and p99 in milliseconds. times_s: at least one."""
    p50, p99 = np.percentile(np.asarray(times_s), (50, 99)) * 1e3
    return float(p50), float(p99)


def rounded(value: float | None, digits: int = 4) -> float | None:
    """Return the value with at most this number of decimals."""
    return None if value is None else round(float(value), digits)


def plain(value: Any) -> Any:
    """Return a value for JSON: at most four decimals, null for NaN, objects for dataclasses, lists for tuples."""
    if isinstance(value, float):
        return round(value, 4) if math.isfinite(value) else None
    if is_dataclass(value) and not isinstance(value, type):
        return plain(asdict(value))
    if isinstance(value, Mapping):
        return {key: plain(one) for key, one in value.items()}
    if isinstance(value, (list, tuple)):
        return [plain(one) for one in value]
    return value


def write_json(path: Path, content: Mapping[str, Any]) -> None:
    """Write an object. Raises InputError if the file cannot be written."""
    try:
        path.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise InputError(f"{path}: cannot be written ({error.strerror}). Choose another folder") from None


def text(value: float | None, form: str = "{:.2f}") -> str:
    """Return a number as text; a dash if it is None."""
    return "–" if value is None else form.format(value)


def figure_table(heads: Sequence[str], rows: Iterable[Sequence[str]], title: str | None = None, gap: int = 1) -> Table:
    """Return a table that breaks no number: the first column is text and takes what the others leave of the width."""
    made = Table(
        title=title, title_justify="left", box=box.SIMPLE_HEAD, show_edge=False, pad_edge=False, padding=(0, gap, 0, 0)
    )
    for number, head in enumerate(heads):
        made.add_column(head, justify="right" if number else "left", no_wrap=bool(number), overflow="fold")
    for row in rows:
        made.add_row(*row)
    return made
