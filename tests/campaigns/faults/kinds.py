"""What can go wrong, how it begins and ends, and by which words the log must name it."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

CAMERA_RANK = ("disconnect", "stall", "corrupt", "frozen", "stamps_ahead", "stamps_behind", "light", "mirrored")
GRIPPER_RANK = ("disconnect", "timeout", "wrong_echo", "late", "fault")
ARM_RANK = ("disconnect", "timeout", "emergency_stop", "protective_stop", "stuck")
RANKS = {"left": CAMERA_RANK, "right": CAMERA_RANK, "gripper": GRIPPER_RANK, "arm": ARM_RANK}
"""By device: of two faults at once only the first can be seen."""
LAST_S = 9.0
"""No fault begins later: a run has time to show what it does."""
FOR_EVER = 0.2
"""This share of the faults is never mended."""

_OLD = "newest frame is"
_CAMERA_WORDS = {
    "disconnect": "unplugged|no DIGIT",
    "stall": f"no frame for|{_OLD}",
    "corrupt": "damaged frame",
    "frozen": "repeats itself",
    "stamps_ahead": "ahead of the clock",
    "stamps_behind": f"{_OLD} .* old",
    "light": "unlike the no-contact image",
    "mirrored": "turn the same way",
    "duplicate": "",
}
_GRIPPER_WORDS = {
    "disconnect": "no gripper answers|connection is (gone|not open)",
    "timeout": "no answer",
    "wrong_echo": "something else than was asked",
    "late": "newest answer is|no answer for",
    "fault": "internal fault",
}
_ARM_WORDS = {
    "disconnect": "no arm answers|connection is (gone|not open)|no state for",
    "timeout": "no state for|newest answer is",
    "protective_stop": "protective stop",
    "emergency_stop": "emergency stop",
    "stuck": "arm stuck",
}


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One way to fail. device: of the simulated world's fault board, or `loop`, `daemon`, `object`."""

    device: str
    fault: str
    words: re.Pattern[str]

    @property
    def name(self) -> str:
        """For people: device and fault."""
        return f"{self.device}.{self.fault}"

    @property
    def needs_a_name(self) -> bool:
        """False for what a stream bears in silence, as cameras do it now and then."""
        return bool(self.words.pattern)


def _kinds() -> dict[str, FaultKind]:
    found = []
    for finger in ("left", "right"):
        for fault, words in _CAMERA_WORDS.items():
            both = fault == "mirrored"
            found.append(FaultKind(finger, fault, re.compile(words if both or not words else f"{finger}.*({words})")))
    found += [FaultKind("gripper", fault, re.compile(f"gripper.*({words})")) for fault, words in _GRIPPER_WORDS.items()]
    found += [FaultKind("arm", fault, re.compile(f"arm.*({words})")) for fault, words in _ARM_WORDS.items()]
    found.append(FaultKind("loop", "late", re.compile("nothing was decided for")))
    found.append(FaultKind("daemon", "killed", re.compile("is held with|taken over")))
    found.append(FaultKind("object", "taken", re.compile("object lost|closed on nothing")))
    return {kind.name: kind for kind in found}


KINDS = _kinds()
MOMENTS = frozenset({"loop.late", "daemon.killed", "object.taken"})
"""What happens, rather than lasts."""


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """One fault of one run. at_s: from the run's start; for_s: infinite if it is never mended.

    Of a late loop and a killed daemon for_s is how long nothing runs.
    """

    kind: FaultKind
    at_s: float
    for_s: float

    @property
    def lasts(self) -> bool:
        """It goes on for a while and then ends by itself."""
        return self.kind.name not in MOMENTS and bool(np.isfinite(self.for_s))

    def __str__(self) -> str:
        ends = "" if np.isinf(self.for_s) else f" for {self.for_s:.2f} s"
        return f"{self.kind.name} at {self.at_s:.2f} s{ends}"


def draw(rng: np.random.Generator, seed: int) -> tuple[PlannedFault, ...]:
    """One to three different faults, at random times; the first goes through all kinds as the seed does."""
    names = list(KINDS)
    count = int(rng.integers(1, 4))
    others = rng.permutation([name for name in names if name != names[seed % len(names)]])
    chosen = [names[seed % len(names)], *(str(name) for name in others[: count - 1])]
    return tuple(_plan(KINDS[name], rng) for name in chosen)


def _plan(kind: FaultKind, rng: np.random.Generator) -> PlannedFault:
    at_s = float(rng.uniform(0.2, LAST_S))
    if kind.device == "loop":
        return PlannedFault(kind, at_s, float(rng.uniform(0.55, 1.5)))
    if kind.device == "daemon":
        return PlannedFault(kind, at_s, float(rng.uniform(0.2, 2.0)))
    ever = rng.random() < FOR_EVER or kind.name in MOMENTS
    return PlannedFault(kind, at_s, float("inf") if ever else float(rng.uniform(0.3, 3.0)))
