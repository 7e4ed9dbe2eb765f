"""An experiment: a list of cases, each run by a function of the case alone, in processes and for a limited time.

The outcomes do not depend on the number of processes, and a case is run again by its name and seed.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from slipguard.tools.parallel import Workers, each

P = TypeVar("P")
R = TypeVar("R")


@dataclass(frozen=True, slots=True)
class Case(Generic[P]):
    """One run of an experiment; picklable.

    Attributes:
        name: The row of the table that it belongs to.
        seed: Of all its random numbers.
        parameters: What else its run depends on.
    """

    name: str
    seed: int
    parameters: P

    def __str__(self) -> str:
        return f"{self.name}, seed {self.seed}"

    def title(self) -> str:
        """Return the name: for messages about cases whose name is unique."""
        return self.name


def run_cases(
    run: Callable[[Case[P]], R],
    cases: Sequence[Case[P]],
    workers: Workers | None = None,
    *,
    named: Callable[[Case[P]], str] = str,
    progress: Callable[[float], None] = lambda share: None,
    seconds: float = math.inf,
    at_least: int = 0,
    clock: Callable[[], float] = time.perf_counter,
) -> Iterator[tuple[Case[P], R]]:
    """Yield each case with its outcome, in the order of the cases, until `seconds` have passed.

    Args:
        run: Function of a case; picklable, except for one process.
        workers: None: this process.
        named: Name of a case in messages.
        progress: Called with the share of the cases, or of the time if that is larger.
        at_least: Number of cases that run whatever time they take.

    Raises:
        SlipguardError: From a case, with the case in front.
    """
    began_s = clock()
    with closing(each(run, cases, Workers(jobs=1) if workers is None else workers, named=named)) as outcomes:
        for done, (case, outcome) in enumerate(zip(cases, outcomes, strict=False), 1):
            spent_s = clock() - began_s
            progress(min(max(done / len(cases), spent_s / seconds), 1.0))
            yield case, outcome
            if spent_s >= seconds and done >= at_least:
                return


@dataclass(frozen=True, slots=True)
class ResultStore(Generic[R]):
    """Results as JSON files, so that a stopped experiment continues where it was.

    Attributes:
        version: Increased when the same input yields other figures; results of other versions are computed again.
        encode, decode: Between a result and its JSON object; `decode` raises KeyError, TypeError or ValueError.
    """

    version: int
    encode: Callable[[R], dict[str, Any]]
    decode: Callable[[dict[str, Any]], R]

    def result(self, source: Path, compute: Callable[[Path], R], *, keep: Callable[[R], bool]) -> R:
        """Return the result stored beside `source`, or compute and store it. keep: whether a stored one is final."""
        path = source.with_suffix(".json")
        if path.exists() and path.stat().st_mtime_ns >= source.stat().st_mtime_ns:
            try:
                stored = json.loads(path.read_text())
                result = self.decode(stored["result"])
                if stored["analysis"] == self.version and keep(result):
                    return result
            except (ValueError, TypeError, KeyError):
                pass  # of another version, or truncated
        result = compute(source)
        part = path.with_suffix(".json.part")
        part.write_text(json.dumps({"analysis": self.version, "result": self.encode(result)}))
        part.replace(path)
        return result
