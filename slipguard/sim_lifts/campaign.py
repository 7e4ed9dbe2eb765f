"""`slipguard --sim`: the daemon with simulated devices lifts one object after the other; the truth is recorded."""

from __future__ import annotations

import asyncio
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from slipguard.config import Config, sim_config
from slipguard.control.control_step import ControlState, control_step, step
from slipguard.control.messages import Observation, StepOutput
from slipguard.control.params import GuardParams
from slipguard.control.reports import FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, LiftRequest, LowerRequest, ReleaseRequest
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.worker import FixedLatencyWorker, ThreadWorker, Worker
from slipguard.daemon.run import build_service
from slipguard.devices import FINGERS
from slipguard.errors import CommandRefused
from slipguard.sim.catalogue import object_names
from slipguard.sim.scenario import scenario, sensor_gel
from slipguard.sim.world import World
from slipguard.sim_lifts.lift_record import EstimatedRotation, LiftRecord
from slipguard.tools.waiting import running_service, wait_until

TRUTH_STEP_S = 0.004
HOLD_S = 1.2
"""Time for which an object is held after the lift, before it is put down."""
PHASE_TIMEOUT_S = 30.0
"""A soft gel takes the load over several seconds: the arm rises slowly until the object hangs."""
LIFT_HEIGHT_MM = 150.0
LIFT_SPEED_MM_S = 80.0
LOWER_SPEED_MM_S = 150.0
"""Fast, because nothing is measured while lowering: ten lifts take one and a half minutes."""
STATED_LATENCY_S = 0.006
"""With --speed fast an estimate is available this long after its frame."""
GRIPPED = frozenset({Phase.REFERENCE, Phase.LIFTING, Phase.HOLDING, Phase.FAULT})
BUSY = frozenset({FaultCode.FRAMES_LOST, FaultCode.LOOP_LATE, FaultCode.MACHINE_BUSY})
HARD_CASES = {"bar": "heavy", "ball": "saturating"}
"""The hard cases of the paper: a heavy object, and one whose curvature saturates the image."""


@dataclass(frozen=True, slots=True)
class CampaignSettings:
    """seed: of the random numbers. lifts: None for one per test object. guarded: False lifts without the guard."""

    seed: int = 0
    lifts: int | None = None
    guarded: bool = True
    realtime: bool = True

    def objects(self) -> list[tuple[str, int]]:
        """Return the objects in order, each with the seed of its scenario."""
        every = object_names("test")
        count = len(every) if self.lifts is None else self.lifts
        return [(every[index % len(every)], self.seed + index // len(every)) for index in range(count)]


@dataclass(slots=True)
class LiftProgress:
    """The current state, for a progress display. latency_ms: None on a virtual clock, where it is no measurement."""

    lift: int = 0
    lifts: int = 0
    object_name: str = ""
    phase: str = ""
    rotation_deg: float | None = None
    sigma_deg: float | None = None
    true_rotation_deg: float = 0.0
    force_n: float = 0.0
    latency_ms: float | None = None


def campaign_config(settings: CampaignSettings, state_directory: Path) -> Config:
    """Return the default configuration with simulated devices; on the real clock images are rendered in processes."""
    return sim_config(
        "process" if settings.realtime else "inline",
        guard={
            "lift_height_mm": LIFT_HEIGHT_MM,
            "lift_speed_mm_s": LIFT_SPEED_MM_S,
            "tuning": {"lower_speed_mm_s": LOWER_SPEED_MM_S},
        },
        state={"directory": str(state_directory)},
    )


async def run_campaign(settings: CampaignSettings, show: Callable[[LiftProgress], None]) -> list[LiftRecord]:
    """Run all lifts and return their records; `show` is called after each control step."""
    with tempfile.TemporaryDirectory(prefix="slipguard-sim-") as folder:
        config = campaign_config(settings, Path(folder))
        world = World(seed=settings.seed)

        def make_worker(name: str) -> Worker:
            return ThreadWorker(name) if settings.realtime else FixedLatencyWorker(STATED_LATENCY_S)

        controller = control_step if settings.guarded else unguarded_step
        service = build_service(
            config,
            world=world,
            make_worker=make_worker,
            controller=controller,
        )
        async with running_service(service) as running:
            return await _lifts(settings, service, world, running, show)


async def _lifts(
    settings: CampaignSettings,
    service: Service,
    world: World,
    running: asyncio.Task[None],
    show: Callable[[LiftProgress], None],
) -> list[LiftRecord]:
    plan = settings.objects()
    progress = LiftProgress(lifts=len(plan))
    handlers = RequestHandlers(service)
    await wait_until(running, lambda: not service.waiting_for, 30.0, "the devices are not ready")
    await handlers.submit(CalibrateRequest())
    records = []
    for index, (name, seed) in enumerate(plan):
        progress.lift, progress.object_name = index + 1, name
        record = LiftRecord(object_name=name, hard=HARD_CASES.get(name, ""))
        records.append(record)
        loop = asyncio.get_running_loop()
        world.place(replace(scenario(name, seed), gel=sensor_gel(settings.seed)), loop.time())
        with _watched(service, world, record, progress, show, realtime=settings.realtime):
            await _one_lift(service, handlers, world, record, running)
        world.clear(loop.time())
        if settings.realtime and ended_by_busy_machine(record):
            break  # the others would end like this one
    return records


def ended_by_busy_machine(record: LiftRecord) -> bool:
    """Return whether a lift in real time ended because this machine was too slow for the cameras or the loop."""
    return record.why in BUSY or record.why.startswith("cannot grasp: not ready")


async def _one_lift(
    service: Service, handlers: RequestHandlers, world: World, record: LiftRecord, running: asyncio.Task[None]
) -> None:
    """Grasp, lift, hold, lower and release one object, and record the outcome."""
    loop = asyncio.get_running_loop()
    missed_before = service.deadlines_missed

    def dropped() -> bool:
        return world.truth(loop.time()).dropped is not None

    async def until(reached: Callable[[], bool], what: str) -> None:
        await wait_until(
            running,
            lambda: reached() or dropped() or service.phase is Phase.FAULT,
            PHASE_TIMEOUT_S,
            f"{record.object_name}: {what}",
        )

    try:
        await handlers.submit(GraspRequest())
        await until(lambda: service.ready_to_lift, "the object was not gripped")
        await handlers.submit(LiftRequest())
        await until(lambda: service.phase is Phase.HOLDING, "the lift did not end")
        hold_until_s = loop.time() + HOLD_S
        await until(lambda: loop.time() >= hold_until_s, "the hold did not end")
    except CommandRefused as refusal:
        record.outcome, record.why = "refused", str(refusal)
    record.ended_at_s = loop.time()
    if dropped():
        record.outcome, record.why = "dropped", str(world.truth(loop.time()).dropped)
        record.ended_at_s = record.truth[-1].time_s
    elif service.phase is Phase.FAULT and service.state.fault is not None:
        record.why = str(service.state.fault.code)
    record.deadlines_missed = service.deadlines_missed - missed_before
    if record.outcome == "held" and service.phase is Phase.HOLDING:
        await handlers.submit(LowerRequest())
        await until(lambda: service.phase is Phase.HOLDING, "the lowering did not end")
    await handlers.submit(ReleaseRequest(confirm=True))
    await wait_until(running, lambda: service.phase is Phase.IDLE, PHASE_TIMEOUT_S, "the release did not end")


@contextmanager
def _watched(
    service: Service,
    world: World,
    record: LiftRecord,
    progress: LiftProgress,
    show: Callable[[LiftProgress], None],
    *,
    realtime: bool,
) -> Iterator[None]:
    """Add truth, estimates and decisions to the record while the body runs."""
    loop = asyncio.get_running_loop()

    def sample_truth() -> None:
        timers[0] = loop.call_later(TRUTH_STEP_S, sample_truth)
        truth = world.truth(loop.time())
        if truth.dropped is None and truth.object_name is not None:
            record.truth.append(truth)
        progress.true_rotation_deg, progress.force_n = truth.rotation_deg, truth.force_n

    def decided(decision: Decision) -> None:
        progress.phase = decision.phase.value
        fresh_grip = decision.output.new_reference  # earlier estimates belong to an older reference
        if decision.phase not in GRIPPED or fresh_grip or loop.time() > record.ended_at_s:
            progress.rotation_deg = progress.sigma_deg = None
            return
        for finger, estimate in decision.new_estimates.items():
            record.estimates[finger].append(estimate)
        record.latency_s.extend(decision.latencies_s)
        fused = decision.observation.fused
        if fused is not None and fused.rotation_deg is not None and fused.sigma_deg is not None:
            if decision.new_estimates:
                record.fused.append(EstimatedRotation(fused.captured_at_s, fused.rotation_deg, fused.sigma_deg))
            progress.rotation_deg, progress.sigma_deg = fused.rotation_deg, fused.sigma_deg
        else:
            progress.rotation_deg = progress.sigma_deg = None
        if realtime and decision.latencies_s:
            progress.latency_ms = 1e3 * decision.latencies_s[-1]
        show(progress)

    timers: list[asyncio.Handle] = [loop.call_soon(sample_truth)]
    try:
        with service.observers.attached(decided), service.hold_observers.attached(record.latency_s.append):
            yield
    finally:
        timers[0].cancel()


def unguarded_step(
    state: ControlState, observation: Observation, params: GuardParams
) -> tuple[ControlState, StepOutput]:
    """Return the control step for an object that seems at rest: the same phases, always with the first force."""
    fused = observation.fused
    if fused is not None and (fused.left_contact or fused.right_contact):
        fused = replace(
            fused,
            rotation_deg=0.0,
            sigma_deg=1.0,
            rate_deg_s=0.0,
            shift_mm=0.0,
            fingers=FINGERS,
            conflict=None,
            declined=None,
        )
    params = params.model_copy(update={"no_estimate_force_n": params.first_force_n})
    grasp, output = step(state.grasp, replace(observation, fused=fused, fault=None), params)
    return replace(state, grasp=grasp), output
