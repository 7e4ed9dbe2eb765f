"""Check this machine: the processor, the segmentation network, the state folder."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

from slipguard.config import Config
from slipguard.daemon.store.state_dir import StateDir
from slipguard.diagnosis import CheckResult, note, ok, problem, problem_from_error
from slipguard.errors import SlipguardError

CORES = 2
"""One for the images of each finger; the loop itself needs little."""
LOAD_SHARE = 0.8


def check_machine(config: Config) -> Iterator[CheckResult]:
    """Run all checks of the machine; opens no device."""
    yield check_processor()
    yield check_network(config)
    yield check_state_folder(StateDir(config.state.directory).path)


def check_processor() -> CheckResult:
    """Check the number of cores for this process, and their load."""
    cores = len(os.sched_getaffinity(0))
    load = os.getloadavg()[0]
    observed = f"{cores} {'core' if cores == 1 else 'cores'}, load {load:.1f}"
    if cores < CORES:
        return note("processor", observed, f"give it {CORES} cores: the images of each finger need one")
    if load > LOAD_SHARE * cores:
        limit = f"limit {LOAD_SHARE * cores:.1f}"
        return note("processor", f"{observed} ({limit})", "stop other programs: they delay slipguard's response")
    return ok("processor", observed)


def check_network(config: Config) -> CheckResult:
    """Check that the segmentation network can be loaded."""
    from slipguard.perception.segmenter import Segmenter  # here, because onnxruntime is slow to import

    try:
        segmenter = Segmenter(config.perception.model)
    except SlipguardError as error:
        return problem_from_error("network", error, "", "remove perception.model to use the included network")
    width, height = segmenter.input_size
    return ok("network", f"{segmenter.path.name}, {width} x {height}")


def check_state_folder(path: Path) -> CheckResult:
    """Check the folder of the background images. It is made when needed, so its parent may be checked instead."""
    existing = path
    while not os.path.lexists(existing) and existing != existing.parent:
        existing = existing.parent
    if not os.path.isdir(existing):
        action = f"move it away, or set state.directory instead of {path}"
        return problem("state folder", f"{existing} is not a folder", action)
    if not os.access(existing, os.W_OK | os.X_OK):
        return problem(
            "state folder",
            f"{existing} is not writable",
            "run as the user of the daemon, or set state.directory in the configuration",
        )
    return ok("state folder", str(path) if existing == path else f"{path}, made when needed")
