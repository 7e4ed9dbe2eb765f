"""Two fingers over a minute of holding: what it is worth not to look at the one that sees less."""

from __future__ import annotations

import time
from dataclasses import dataclass, field

import numpy as np

from slipguard.bench.minute import HoldingScene
from slipguard.bench.onset import PARAMS
from slipguard.bench.pipelines import BenchPipeline
from slipguard.bench.rows import SkipResult
from slipguard.control.finger_fusion import fuse
from slipguard.control.slip_baselines import SlipMemory
from slipguard.control.slip_detector import look
from slipguard.perception.contact.second_finger import repeat_estimate, second_finger_can_skip
from slipguard.perception.estimate import Estimate
from slipguard.perception.settings import PerceptionSettings

SURER, OTHER = HoldingScene("wrench", 6000), HoldingScene("wrench", 6005, press=0.25, sign=-1.0)
"""The other finger's contact is faint: often too faint to tell an unchanged picture."""


@dataclass(slots=True)
class _FingerRun:
    """spent_s: on the second finger. seen: frames on which the law saw slip begin."""

    spent_s: list[float] = field(default_factory=list)
    errors_deg: list[float] = field(default_factory=list)
    seen: list[int] = field(default_factory=list)
    spared: int = 0


def second_finger(default: BenchPipeline) -> SkipResult:
    """The minute with both fingers looked at, and with the second one spared."""
    runs = {True: _FingerRun(), False: _FingerRun()}
    surer = default.open(SURER.scene())
    others = {spare: default.open(OTHER.scene()) for spare in runs}
    detectors, slipping = dict.fromkeys(runs, SlipMemory()), dict.fromkeys(runs, False)
    last: dict[bool, Estimate | None] = dict.fromkeys(runs)
    refresh_s = PerceptionSettings().refresh_s
    for index, (shot, beside) in enumerate(zip(SURER.shots(), OTHER.shots(), strict=True)):
        left = surer.process(shot.frame)
        for spare, run in runs.items():
            own, frame = last[spare], beside.frame
            start_s = time.process_time()
            if spare and own is not None and second_finger_can_skip(own, left, frame.captured_at_s, refresh_s):
                right = repeat_estimate(own, frame.captured_at_s, frame.sequence)
                run.spared += 1
            else:
                right = others[spare].process(frame)
            run.spent_s.append(time.process_time() - start_s)
            last[spare] = right
            fused = fuse(left, right)
            if fused is None:
                continue
            if shot.compared and fused.rotation_deg is not None:
                run.errors_deg.append(abs(fused.rotation_deg - shot.rotation_deg))
            sight = look(detectors[spare], fused, PARAMS)
            detectors[spare] = sight.detector
            if sight.slipping and not slipping[spare]:
                run.seen.append(index)
            slipping[spare] = sight.slipping
    spared, plain = runs[True], runs[False]
    saved_ms = 1e3 * (float(np.mean(plain.spent_s)) - float(np.mean(spared.spent_s)))
    later = [one - other for one, other in zip(spared.seen, plain.seen, strict=False)]
    if len(spared.seen) < len(plain.seen):
        later.append(len(plain.spent_s))
    return SkipResult(
        "second finger adds nothing: its last answer",
        True,
        saved_ms * len(plain.spent_s) / max(spared.spared, 1),
        saved_ms,
        float(np.mean(spared.errors_deg) - np.mean(plain.errors_deg)),
        max(later, default=None),
        f"{spared.spared} of {len(plain.spent_s)} frames of the finger that is pressed less; {len(plain.seen)} slips",
    )
