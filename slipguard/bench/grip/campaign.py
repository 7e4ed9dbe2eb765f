"""The campaign: every trial with every controller, some also with rendered frames, and stable holds.

Further blocks of trials: the support is removed at once; the needed force is close to the force limit, so that one
step is not enough; and the same with the small force limit of a fragile object.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from slipguard.bench.grip.stable_holds import HoldOutcome, StableHold, holds, run_hold
from slipguard.bench.grip.trial_run import CONTROLLER_NAMES, ControllerName, TrialOutcome, run_trial
from slipguard.bench.grip.trials import Block, Event, GripTrial, trials
from slipguard.tools.parallel import Workers, each

QUICK_TRIALS, FULL_TRIALS = 32, None
QUICK_RENDERED, FULL_RENDERED = 20, 100
QUICK_GONE, FULL_GONE = 12, 144
"""Trials in which the support is removed."""
QUICK_TIGHT, FULL_TIGHT = 8, 144
"""Trials with a high needed force, and as many with fragile objects."""
QUICK_MINUTES, FULL_MINUTES = 3.0, 60.0
HOLD_S = 60.0
QUICK_RENDERED_HOLDS, FULL_RENDERED_HOLDS = 1, 6
QUICK_RENDERED_HOLD_S, FULL_RENDERED_HOLD_S = 4.0, 30.0
SUPPORT_GONE_NUMBERS = 5_000


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """Trials and holds to run."""

    trials: tuple[GripTrial, ...]
    gone: tuple[GripTrial, ...]
    tight: tuple[GripTrial, ...]
    holds: tuple[StableHold, ...]

    @classmethod
    def of(cls, *, quick: bool, seed: int = 0) -> CampaignPlan:
        """Return the quick plan or the full one. Equal seeds give equal plans."""
        lifted = trials(QUICK_TRIALS if quick else FULL_TRIALS, QUICK_RENDERED if quick else FULL_RENDERED, seed)
        dropped = [
            replace(trial, event="support gone", number=SUPPORT_GONE_NUMBERS + trial.number)
            for trial in trials(QUICK_GONE if quick else FULL_GONE, 0, seed + 1)
        ]
        count = QUICK_TIGHT if quick else FULL_TIGHT
        tight = [*trials(count, 0, seed + 2, "high need"), *trials(count, 0, seed + 3, "fragile")]
        held = holds(QUICK_MINUTES if quick else FULL_MINUTES, seed, HOLD_S)
        drawn, each_s = QUICK_RENDERED_HOLDS, QUICK_RENDERED_HOLD_S
        if not quick:
            drawn, each_s = FULL_RENDERED_HOLDS, FULL_RENDERED_HOLD_S
        seen = holds(drawn * each_s / 60.0, seed, each_s, rendered=True) if drawn else []
        return cls(tuple(lifted), tuple(dropped), tuple(tight), (*held, *seen))

    @property
    def rendered(self) -> int:
        """Number of trials with rendered frames and the shipped pipeline."""
        return sum(trial.rendered for trial in self.trials)


@dataclass(frozen=True, slots=True)
class TrialOutcomes:
    """Outcomes of one trial by controller, with the error model; and of slipguard with rendered frames."""

    trial: GripTrial
    outcomes: dict[ControllerName, TrialOutcome]
    rendered: TrialOutcome | None = None

    @property
    def slipguard(self) -> TrialOutcome:
        """slipguard's outcome, with rendered frames if there is one."""
        return self.outcomes["slipguard"] if self.rendered is None else self.rendered


@dataclass(frozen=True, slots=True)
class GripCampaignResult:
    """Results of all trials and holds."""

    trials: tuple[TrialOutcomes, ...]
    gone: tuple[TrialOutcomes, ...]
    high_need: tuple[TrialOutcomes, ...]
    fragile: tuple[TrialOutcomes, ...]
    holds: tuple[HoldOutcome, ...]


def run(
    plan: CampaignPlan, workers: Workers, progress: Callable[[float], None] = lambda share: None
) -> GripCampaignResult:
    """Run everything; progress(share done) is called repeatedly."""
    everything: list[GripTrial | StableHold] = [*plan.trials, *plan.gone, *plan.tight, *plan.holds]
    items = sorted(everything, key=lambda item: not item.rendered)  # slow ones first
    results = list(each(_run_item, items, workers, named=_describe, progress=lambda done: progress(done / len(items))))
    played = sorted((one for one in results if isinstance(one, TrialOutcomes)), key=lambda one: one.trial.number)

    def block(name: Block, event: Event = "lifted") -> tuple[TrialOutcomes, ...]:
        return tuple(one for one in played if one.trial.block == name and one.trial.event == event)

    return GripCampaignResult(
        trials=block("matrix"),
        gone=block("matrix", "support gone"),
        high_need=block("high need"),
        fragile=block("fragile"),
        holds=tuple(one for one in results if isinstance(one, HoldOutcome)),
    )


def _run_item(item: GripTrial | StableHold) -> TrialOutcomes | HoldOutcome:
    if isinstance(item, StableHold):
        return run_hold(item)
    outcomes = {who: run_trial(item, who) for who in CONTROLLER_NAMES}
    return TrialOutcomes(item, outcomes, run_trial(item, "slipguard", rendered=True) if item.rendered else None)


def _describe(item: GripTrial | StableHold) -> str:
    return item.trial.name if isinstance(item, StableHold) else item.name
