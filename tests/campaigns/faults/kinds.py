"""The faults of the campaign: when they begin and end, and the words by which the log must name them."""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from slipguard.perception.estimate import DeclineReason

CAMERA_RANK = ("disconnect", "stall", "corrupt", "frozen", "stamps_ahead", "stamps_behind", "light", "mirrored")
GRIPPER_RANK = ("disconnect", "timeout", "wrong_echo", "late", "fault")
ARM_RANK = ("disconnect", "timeout", "emergency_stop", "protective_stop", "stuck")
RANKS = {"left": CAMERA_RANK, "right": CAMERA_RANK, "gripper": GRIPPER_RANK, "arm": ARM_RANK}
"""Faults of a device by severity: of two at once only the first is observable."""
LAST_S = 9.0
"""Latest begin of a fault, so that its effect falls into the run."""
PERMANENT_SHARE = 0.2
"""Share of the faults that are never repaired."""

_CAMERA_WORDS = {
    "disconnect": "unplugged|no DIGIT",
    "stall": "no frame for",
    "corrupt": "damaged frame",
    "frozen": "repeats itself",
    "stamps_ahead": "ahead of the clock",
    "stamps_behind": "before they arrive",
    "light": str(DeclineReason.IMAGE),
    "mirrored": "rotate the same way",
    "duplicate": "",
}
_GRIPPER_WORDS = {
    "disconnect": "no gripper answers|connection is (gone|not open)",
    "timeout": "no response",
    "wrong_echo": "a response to another request",
    "late": "newest response is|no response for",
    "fault": "internal fault",
}
_ARM_WORDS = {
    "disconnect": "no arm answers|connection is (gone|not open)|no state for",
    "timeout": "no state for|newest response is",
    "protective_stop": "protective stop",
    "emergency_stop": "emergency stop",
    "stuck": "stuck",
}


@dataclass(frozen=True, slots=True)
class FaultKind:
    """One kind of fault. device: a device of `InjectedFaults`, or `loop`, `daemon`, `object`."""

    device: str
    fault: str
    words: re.Pattern[str]

    @property
    def name(self) -> str:
        """Device and fault, for display."""
        return f"{self.device}.{self.fault}"

    @property
    def must_be_named(self) -> bool:
        """False for faults that are normal for a camera now and then."""
        return bool(self.words.pattern)


def _kinds() -> dict[str, FaultKind]:
    found = []
    for finger in ("left", "right"):
        for fault, words in _CAMERA_WORDS.items():
            both = fault == "mirrored"
            found.append(FaultKind(finger, fault, re.compile(words if both or not words else f"{finger}.*({words})")))
    found += [FaultKind("gripper", fault, re.compile(f"gripper.*({words})")) for fault, words in _GRIPPER_WORDS.items()]
    found += [FaultKind("arm", fault, re.compile(f"arm.*({words})")) for fault, words in _ARM_WORDS.items()]
    found.append(FaultKind("loop", "late", re.compile("no control step for")))
    found.append(FaultKind("daemon", "killed", re.compile("is held with|taken over")))
    found.append(FaultKind("object", "taken", re.compile("object lost|closed on nothing")))
    return {kind.name: kind for kind in found}


KINDS = _kinds()
INSTANTANEOUS = frozenset({"loop.late", "daemon.killed", "object.taken"})
"""Faults that happen at one moment."""


@dataclass(frozen=True, slots=True)
class PlannedFault:
    """One fault of one run.

    Attributes:
        at_s: from the start of the run.
        for_s: duration, infinite if never repaired; for a late loop and a killed daemon, how long nothing runs.
    """

    kind: FaultKind
    at_s: float
    for_s: float

    @property
    def lasts(self) -> bool:
        """Whether it lasts for a while and then ends."""
        return self.kind.name not in INSTANTANEOUS and bool(np.isfinite(self.for_s))

    def __str__(self) -> str:
        ends = "" if np.isinf(self.for_s) else f" for {self.for_s:.2f} s"
        return f"{self.kind.name} at {self.at_s:.2f} s{ends}"


def draw(rng: np.random.Generator, seed: int) -> tuple[PlannedFault, ...]:
    """Return one to three different faults at random times; the first kind follows from the seed."""
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
    ever = rng.random() < PERMANENT_SHARE or kind.name in INSTANTANEOUS
    return PlannedFault(kind, at_s, float("inf") if ever else float(rng.uniform(0.3, 3.0)))
