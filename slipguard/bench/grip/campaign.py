"""The campaign: every scenario with every controller, some also with rendered frames."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial

from slipguard.bench.grip.added_mass import AddedMass, added_mass_scenarios, run_added_mass
from slipguard.bench.grip.lift_course import GripOutcome
from slipguard.bench.grip.lift_run import CONSTANTS, PlantName, constant_n, run_lift
from slipguard.bench.grip.scenarios import FIRST_TEST_SEED, GripScenario, scenarios
from slipguard.tools.parallel import Workers, each

QUICK_SCENARIOS, FULL_SCENARIOS = 48, 180
QUICK_RENDERED, FULL_RENDERED = 4, 40
"""Scenarios with a weak first grip that also run with rendered frames and the shipped pipeline."""
QUICK_ADDED, FULL_ADDED = 24, 120
"""Scenarios in which mass is added on the grip axis."""
QUICK_HOLD_S, FULL_HOLD_S = 4.0, 20.0
"""Duration of the hold after the lift of a firm grasp."""
STEPS = ("naive steps", "proportional steps", "fixed step")
BASELINES = ("no guard", *(f"constant {share:.2f}" for share in CONSTANTS), *STEPS)
BOUND = "clairvoyant"
REACTIVE = "reactive"
REACTING = ("slipguard", *STEPS)
ANSWERABLE_DEG, ANSWERABLE_MM = 2.5, 2.5
"""If the clairvoyant bound slips further, the load arrives faster than the gripper tightens; if the reactive one does,
faster than camera, wire and jaws act together."""
NO_SLIP, CERTAIN = 0.05, 1.25
"""A constant that holds without slip at this multiple of the needed force holds at any larger one: it is not run."""


@dataclass(frozen=True, slots=True)
class CampaignPlan:
    """What to run."""

    scenarios: tuple[GripScenario, ...]
    rendered: int
    hold_s: float
    seed: int
    plant: PlantName
    added: int

    @classmethod
    def of(cls, *, quick: bool, seed: int = 0, plant: PlantName = "own") -> CampaignPlan:
        """Return the quick plan or the full one. Equal seeds give equal scenarios on both plants."""
        if quick:
            return cls(tuple(scenarios(QUICK_SCENARIOS, seed)), QUICK_RENDERED, QUICK_HOLD_S, seed, plant, QUICK_ADDED)
        return cls(tuple(scenarios(FULL_SCENARIOS, seed)), FULL_RENDERED, FULL_HOLD_S, seed, plant, FULL_ADDED)

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
    added_mass: tuple[AddedMass, ...] = ()

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
    work = partial(run_scenario, plant=plan.plant, hold_s=plan.hold_s)
    items = sorted(((one, one.number in drawn) for one in plan.scenarios), key=lambda item: not item[1])
    slides = added_mass_scenarios(plan.added, plan.seed)
    count = len(items) + len(slides)
    results = each(work, items, workers, named=lambda item: item[0].name, progress=lambda done: progress(done / count))
    found = tuple(sorted(results, key=lambda one: one.scenario.number))
    added = each(
        partial(run_added_mass, plant=plan.plant),
        slides,
        workers,
        named=lambda item: f"added mass {item[1].seed}/{item[1].number}",
        progress=lambda done: progress((len(items) + done) / count),
    )
    return GripCampaignResult(plan, found, tuple(added))


def run_scenario(item: tuple[GripScenario, bool], plant: PlantName, hold_s: float) -> ScenarioResult:
    """Run a scenario with every controller that matters for it; item: the scenario, and whether frames are rendered."""
    scenario, rendered = item
    outcomes: dict[str, GripOutcome] = {BOUND: run_lift(scenario, BOUND, plant)}
    held_s = hold_s if scenario.firm else 0.0
    outcomes |= {name: run_lift(scenario, name, plant, hold_s=held_s) for name in REACTING}
    if scenario.weak:
        outcomes |= {name: run_lift(scenario, name, plant) for name in (REACTIVE, "no guard")}
        outcomes |= _constants(scenario, plant)
    seen = run_lift(scenario, "slipguard", plant, rendered=True) if rendered else None
    return ScenarioResult(scenario, outcomes, seen)


def _constants(scenario: GripScenario, plant: PlantName) -> dict[str, GripOutcome]:
    """Return the outcomes of all constant forces."""
    outcomes: dict[str, GripOutcome] = {}
    certain: GripOutcome | None = None
    for share in CONSTANTS:
        name = f"constant {share:.2f}"
        if certain is None:
            outcome = outcomes[name] = run_lift(scenario, name, plant)
            slips = max(outcome.slip_deg, outcome.slide_mm) > NO_SLIP
            certain = outcome if not slips and outcome.force_over_needed > CERTAIN else None
        else:
            gripper = scenario.pose.gripper
            force_n = gripper.gain * gripper.quantized_force_n(constant_n(name, scenario))
            outcomes[name] = replace(certain, controller=name, force_n=force_n)
    return outcomes
