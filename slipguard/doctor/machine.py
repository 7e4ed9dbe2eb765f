"""This machine: the processor, the network file, the folder that must keep things, and the daemon's socket."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from slipguard.config import Config
from slipguard.daemon.store.state_dir import StateDir
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import SlipguardError

CORES = 2
"""One for each finger's pictures; the loop itself needs little."""
LOAD_SHARE = 0.8


def look(config: Config) -> Iterator[CheckResult]:
    """All of it; opens no device."""
    yield processor()
    yield network(config)
    yield state_folder(StateDir(config.state.directory).path)


def processor() -> CheckResult:
    """Cores for this process, and how busy they are."""
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    observed = f"{cores} {'core' if cores == 1 else 'cores'}, load {load:.1f}"
    if cores < CORES:
        return note("processor", observed, f"give it {CORES} cores: each finger's pictures keep one busy")
    if load > LOAD_SHARE * cores:
        return note("processor", observed, "other programs take its time; slipguard answers late when it has to wait")
    return ok("processor", observed)


def network(config: Config) -> CheckResult:
    """The segmentation network loads and keeps its contract."""
    from slipguard.perception.contact.segmenter import Segmenter  # onnxruntime: only whoever asks pays for it

    try:
        segmenter = Segmenter(config.perception.model)
    except SlipguardError as error:
        return problem_from_error("network", error, "", "leave perception.model out: one is shipped")
    width, height = segmenter.input_size
    return ok("network", f"{segmenter.path.name}, {width} x {height}")


def state_folder(path: Path) -> CheckResult:
    """Where no-contact images are kept. It is made when first needed, so its parent counts as well."""
    there = path
    while not os.path.lexists(there) and there != there.parent:
        there = there.parent
    if not os.path.isdir(there):
        return problem(
            "state folder", f"{there} is no folder", f"move it away, or set state.directory instead of {path}"
        )
    if not os.access(there, os.W_OK | os.X_OK):
        return problem(
            "state folder",
            f"{there} cannot be written to",
            "become the user the daemon runs as, or set state.directory in the configuration",
        )
    return ok("state folder", str(path) if there == path else f"{path}, made when needed")
