"""Lifts on the virtual clock with rendered frames, some of them torn: drops, and tightenings that no motion caused."""

from __future__ import annotations

import asyncio
import tempfile
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np

from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, LiftRequest, ReleaseRequest
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.sim.catalogue import find_object
from slipguard.sim.scenario import CameraModel, scenario
from slipguard.sim.world import World
from slipguard.sim_lifts.campaign import STATED_LATENCY_S, CampaignSettings, campaign_config
from slipguard.tools.waiting import wait_until

HOLD_S = 3.0
PHASE_TIMEOUT_S = 15.0
MOVED_WITHIN_S, MOVED_DEG, MOVED_MM = 0.5, 0.3, 0.1
"""A tightening has a cause if the object has really rotated or slid by this much within this time before it."""


@dataclass(frozen=True, slots=True)
class LiftKind:
    """A kind of lift. force_share: first force over the needed one. mass, lever: factors on those of the object."""

    force_share: float
    mass: float = 1.0
    lever: float = 1.0


LIFT_KINDS = {
    "firm": LiftKind(5.0, mass=0.1, lever=0.5),
    "rotates": LiftKind(0.85),
    "slides": LiftKind(0.85, lever=0.03),
}
"""Without tears nothing is dropped in any of them, and hardly a firm grip is tightened."""


class TearingWorld(World):
    """A world whose cameras tear a share of their frames."""

    tear_probability = 0.0

    def camera(self, finger: str) -> CameraModel:
        """Return the camera model with the given share of torn frames."""
        return replace(super().camera(finger), tear_probability=self.tear_probability)


@dataclass(slots=True)
class TornLift:
    """One lift. tightenings: commands that raised the force while held; causeless: those without a motion before."""

    object_name: str
    kind: str
    share: float
    seed: int = 0
    outcome: str = "held"
    tightenings: int = 0
    causeless: int = 0
    rotation_deg: float = 0.0
    slip_mm: float = 0.0
    force_n: float = 0.0
    frames: int = 0
    torn: int = 0
    restarts: int = 0
    errors_deg: list[float] = field(default_factory=list)

    def as_json(self) -> dict[str, object]:
        """Return the figures."""
        figures = asdict(self)
        errors = figures.pop("errors_deg")
        figures["error_mean_deg"] = round(float(np.mean(errors)), 3) if errors else None
        figures["error_max_deg"] = round(float(np.max(errors)), 2) if errors else None
        return figures


def torn_lift(object_name: str, kind: str, share: float, seed: int = 0) -> TornLift:
    """Grasp, lift, hold and release one object with this share of torn frames in both cameras.

    Equal arguments give equal lifts; the share changes nothing but the tears.
    """
    with tempfile.TemporaryDirectory(prefix="slipguard-torn-") as folder:
        return run_virtual(_lift(TornLift(object_name, kind, share, seed), Path(folder)))


async def _lift(record: TornLift, folder: Path) -> TornLift:
    kind, loop = LIFT_KINDS[record.kind], asyncio.get_running_loop()
    item = find_object(record.object_name)
    item = replace(
        item,
        com_offset_mm=kind.lever * item.com_offset_mm,
        mass_kg=kind.mass * item.mass_kg,
        inertia_kg_m2=kind.mass * item.inertia_kg_m2,
    )
    world = TearingWorld(seed=record.seed, lookup=lambda _name: item)
    config = campaign_config(CampaignSettings(realtime=False), folder)
    service = build_service(config, world=world, make_worker=lambda name: FixedLatencyWorker(STATED_LATENCY_S))
    handlers = RequestHandlers(service)
    poses: list[tuple[float, float, float]] = []
    held = False

    def moved(now_s: float) -> bool:
        recent = np.array([pose for pose in poses if pose[0] >= now_s - MOVED_WITHIN_S])
        _, deg, mm = np.ptp(recent, axis=0)
        return bool(deg >= MOVED_DEG or mm >= MOVED_MM)

    def decided(decision: Decision) -> None:
        nonlocal held
        now_s, truth = loop.time(), world.truth(loop.time())
        if truth.dropped is not None:
            return
        poses.append((now_s, truth.rotation_deg, truth.slip_mm))
        force_n, fused = decision.output.hold_force_n, decision.observation.fused
        lifted = decision.phase in (Phase.LIFTING, Phase.HOLDING)
        if lifted and held and force_n is not None and force_n > truth.applied_n + 0.5:
            record.tightenings += 1
            record.causeless += not moved(now_s)
        held = held or lifted
        if lifted and decision.new_estimates and fused is not None and fused.rotation_deg is not None:
            times_s, degs, _ = np.array(poses).T
            record.errors_deg.append(abs(fused.rotation_deg - float(np.interp(fused.captured_at_s, times_s, degs))))

    running = asyncio.create_task(service.run(), name="service")

    async def until(phase: Phase) -> None:
        ended = (phase, Phase.FAULT)
        await wait_until(
            running,
            lambda: service.phase in ended or world.truth(loop.time()).dropped is not None,
            PHASE_TIMEOUT_S,
            f"{record.object_name}: {phase} was not reached",
        )

    try:
        await wait_until(running, lambda: not service.waiting_for, 30.0, "the devices are not ready")
        await handlers.submit(CalibrateRequest())
        world.tear_probability = record.share
        world.place(scenario(record.object_name, record.seed), loop.time())
        service.observers.append(decided)
        force_n = kind.force_share * world.truth(loop.time()).needed_force_n
        await handlers.submit(GraspRequest(force_n=force_n))
        await wait_until(running, lambda: service.ready_to_lift, PHASE_TIMEOUT_S, f"{record.object_name}: not gripped")
        await handlers.submit(LiftRequest())
        await until(Phase.HOLDING)
        await asyncio.sleep(HOLD_S)
        truth = world.truth(loop.time())
        fault = service.state.fault
        record.outcome = "dropped" if truth.dropped else f"fault: {fault.code}" if fault else "held"
        record.rotation_deg, record.slip_mm = round(truth.rotation_deg, 1), round(truth.slip_mm, 2)
        record.force_n = round(truth.force_n, 1)
        for finger in service.fingers.values():
            record.frames += finger.capture.counts.frames
            record.torn += finger.capture.counts.torn
            record.restarts += finger.capture.counts.restarts
        await handlers.submit(ReleaseRequest(confirm=True))
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    return record
