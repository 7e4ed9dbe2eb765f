"""Lifts on the virtual clock with rendered frames, some of them torn: drops, and tightenings that no slip caused."""

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
from slipguard.sim.scenario import CameraModel, scenario
from slipguard.sim.world import World
from slipguard.sim_lifts.campaign import STATED_LATENCY_S, CampaignSettings, campaign_config
from slipguard.tools.waiting import wait_until

HOLD_S = 3.0
PHASE_TIMEOUT_S = 15.0
MOVED_WITHIN_S, MOVED_DEG = 0.5, 0.3
"""A tightening has a cause if the object has really rotated by this much within this time before it."""


class TearingWorld(World):
    """A world whose cameras tear a share of their frames."""

    tear_probability = 0.0

    def camera(self, finger: str) -> CameraModel:
        """Return the camera model with the given share of torn frames."""
        return replace(super().camera(finger), tear_probability=self.tear_probability)


@dataclass(slots=True)
class TornLift:
    """One lift. tightenings: commands that raised the force while held; causeless: those without a rotation."""

    object_name: str
    share: float
    outcome: str = "held"
    tightenings: int = 0
    causeless: int = 0
    rotation_deg: float = 0.0
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


def torn_lift(object_name: str, share: float, seed: int = 0) -> TornLift:
    """Grasp, lift, hold and release one object with this share of torn frames in both cameras."""
    with tempfile.TemporaryDirectory(prefix="slipguard-torn-") as folder:
        return run_virtual(_lift(object_name, share, seed, Path(folder)))


async def _lift(object_name: str, share: float, seed: int, folder: Path) -> TornLift:
    record, world, loop = TornLift(object_name, share), TearingWorld(seed=seed), asyncio.get_running_loop()
    config = campaign_config(CampaignSettings(realtime=False), folder)
    service = build_service(config, world=world, make_worker=lambda name: FixedLatencyWorker(STATED_LATENCY_S))
    handlers = RequestHandlers(service)
    rotations: list[tuple[float, float]] = []
    held = False

    def decided(decision: Decision) -> None:
        nonlocal held
        now_s, truth = loop.time(), world.truth(loop.time())
        if truth.dropped is not None:
            return
        rotations.append((now_s, truth.rotation_deg))
        force_n, fused = decision.output.hold_force_n, decision.observation.fused
        lifted = decision.phase in (Phase.LIFTING, Phase.HOLDING)
        if lifted and held and force_n is not None and force_n > truth.force_n + 0.5:
            record.tightenings += 1
            recent = [deg for at_s, deg in rotations if at_s >= now_s - MOVED_WITHIN_S]
            record.causeless += max(recent) - min(recent) < MOVED_DEG
        held = held or lifted
        if lifted and decision.new_estimates and fused is not None and fused.rotation_deg is not None:
            times_s, degs = np.array(rotations).T
            record.errors_deg.append(abs(fused.rotation_deg - float(np.interp(fused.captured_at_s, times_s, degs))))

    running = asyncio.create_task(service.run(), name="service")

    async def until(phase: Phase) -> None:
        ended = (phase, Phase.FAULT)
        await wait_until(
            running,
            lambda: service.phase in ended or world.truth(loop.time()).dropped is not None,
            PHASE_TIMEOUT_S,
            f"{object_name}: {phase} was not reached",
        )

    try:
        await wait_until(running, lambda: not service.waiting_for, 30.0, "the devices are not ready")
        await handlers.submit(CalibrateRequest())
        world.tear_probability = share
        world.place(scenario(object_name, seed), loop.time())
        service.observers.append(decided)
        await handlers.submit(GraspRequest())
        await wait_until(running, lambda: service.ready_to_lift, PHASE_TIMEOUT_S, f"{object_name}: not gripped")
        await handlers.submit(LiftRequest())
        await until(Phase.HOLDING)
        await asyncio.sleep(HOLD_S)
        truth = world.truth(loop.time())
        fault = service.state.fault
        record.outcome = "dropped" if truth.dropped else f"fault: {fault.code}" if fault else "held"
        record.rotation_deg, record.force_n = round(truth.rotation_deg, 1), round(truth.force_n, 1)
        for finger in service.fingers.values():
            record.frames += finger.capture.counts.frames
            record.torn += finger.capture.counts.torn
            record.restarts += finger.capture.counts.restarts
        await handlers.submit(ReleaseRequest(confirm=True))
    finally:
        running.cancel()
        await asyncio.gather(running, return_exceptions=True)
    return record
