"""The campaign: every scenario with every controller on one plant, some also with rendered frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

from slipguard.bench.grip.lift_course import GripOutcome
from slipguard.bench.grip.lift_run import CONSTANTS, NAIVE_DEG, PlantName, run_lift
from slipguard.bench.grip.scenarios import FIRST_TEST_SEED, GripScenario, scenarios
from slipguard.tools.parallel import Workers, each

QUICK_SCENARIOS, FULL_SCENARIOS = 32, 180
QUICK_RENDERED, FULL_RENDERED = 4, 24
"""Scenarios with a weak first grip that also run with rendered frames and the shipped pipeline."""
NAIVE = tuple(f"naive {deg:g}°" for deg in NAIVE_DEG)
FIXED_STEP = "fixed step"
BASELINES = ("no guard", *(f"constant {share:.2f}" for share in CONSTANTS), *NAIVE, FIXED_STEP)
BOUND, REACTIVE = "clairvoyant", "reactive"
REACTING = ("slipguard", NAIVE[0], FIXED_STEP)
DISTURBED_AFTER = frozenset({"lift", "mass added", "acceleration"})
"""Events after which the held object is disturbed and put down: it lies on a table before, and nothing pushes it."""
ANSWERABLE_DEG, ANSWERABLE_MM = 2.5, 2.5
"""If the clairvoyant bound slips further, the load arrives faster than the gripper tightens; if the reactive one does,
faster than camera, wire and jaws act together."""


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """What to run. Equal seeds give equal scenarios on both plants."""

    scenarios: tuple[GripScenario, ...]
    rendered: int
    seed: int
    plant: PlantName

    @classmethod
    def of(cls, *, quick: bool, seed: int = 0, plant: PlantName = "own") -> CampaignPlan:
        """Return the quick plan or the full one."""
        count, rendered = (QUICK_SCENARIOS, QUICK_RENDERED) if quick else (FULL_SCENARIOS, FULL_RENDERED)
        return cls(tuple(scenarios(count, seed)), rendered, seed, plant)

    @property
    def seed_set(self) -> str:
        """Whether controllers may be tuned on these scenarios ("tuning") or not ("test")."""
        return "test" if self.seed >= FIRST_TEST_SEED else "tuning"


@dataclass(frozen=True, slots=True)
class ScenarioResult:
    """Outcomes of one scenario by controller; rendered: slipguard's with rendered frames."""

    scenario: GripScenario
    outcomes: dict[str, GripOutcome]
    rendered: GripOutcome | None = None

    @property
    def slipguard(self) -> GripOutcome:
        return self.outcomes["slipguard"]

    @property
    def holdable(self) -> bool:
        """Whether the clairvoyant bound holds the object."""
        return self.outcomes[BOUND].dropped is None

    @property
    def answerable(self) -> bool:
        """Whether the actuator is fast enough to keep the slip small: the clairvoyant bound does."""
        return _small(self.outcomes[BOUND])

    @property
    def avoidable(self) -> bool:
        """Whether a controller that reacts to what the cameras see can keep the slip small: the reactive bound does."""
        return _small(self.outcomes[REACTIVE])


def _small(outcome: GripOutcome) -> bool:
    return outcome.slip_deg <= ANSWERABLE_DEG and outcome.slide_mm <= ANSWERABLE_MM


@dataclass(frozen=True, slots=True)
class GripCampaignResult:
    """Results of all scenarios."""

    plan: CampaignPlan
    results: tuple[ScenarioResult, ...]

    @property
    def weak(self) -> list[ScenarioResult]:
        """Lifts with a first grip that is too weak, as far as the actuator can answer."""
        return [one for one in self.results if one.scenario.weak and one.answerable]

    @property
    def beyond_actuator(self) -> list[ScenarioResult]:
        """Weak lifts in which load arrives faster than the gripper tightens: no controller holds them."""
        return [one for one in self.results if one.scenario.weak and not one.answerable]

    @property
    def avoidable(self) -> list[ScenarioResult]:
        """Lifts with a first grip that is too weak, as far as camera, wire and jaws can answer."""
        return [one for one in self.results if one.scenario.weak and one.avoidable]

    @property
    def firm(self) -> list[ScenarioResult]:
        return [one for one in self.results if one.scenario.firm]


def run(
    plan: CampaignPlan, workers: Workers, progress: Callable[[float], None] = lambda share: None
) -> GripCampaignResult:
    """Run everything; progress(share done) is called repeatedly."""
    weak = [one.number for one in plan.scenarios if one.weak]
    every = max(len(weak) // max(plan.rendered, 1), 1)
    drawn = set(weak[::every][: plan.rendered])
    items = sorted(((one, one.number in drawn) for one in plan.scenarios), key=lambda item: not item[1])
    results = each(
        partial(run_scenario, plant=plan.plant),
        items,
        workers,
        named=lambda item: item[0].name,
        progress=lambda done: progress(done / len(items)),
    )
    return GripCampaignResult(plan, tuple(sorted(results, key=lambda one: one.scenario.number)))


def run_scenario(item: tuple[GripScenario, bool], plant: PlantName) -> ScenarioResult:
    """Run a scenario with every controller that matters for it; item: the scenario, and whether frames are rendered."""
    scenario, rendered = item
    names = (*REACTING, BOUND, *((REACTIVE, *BASELINES) if scenario.weak else ()))
    disturbed = {"slipguard", BOUND} if scenario.event in DISTURBED_AFTER else set()
    outcomes = {name: run_lift(scenario, name, plant, disturbed=name in disturbed) for name in dict.fromkeys(names)}
    seen = run_lift(scenario, "slipguard", plant, rendered=True) if rendered else None
    return ScenarioResult(scenario, outcomes, seen)
