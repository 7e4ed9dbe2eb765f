"""The experiment in the simulated world: the daemon on the fakes, and a rendered external camera."""

from __future__ import annotations

import asyncio
import logging
import math
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from slipguard.config import sim_config
from slipguard.control.state import Phase
from slipguard.daemon import log_setup as log
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import CalibrateRequest, GraspRequest, GuardRequest, LiftRequest
from slipguard.daemon.loop.service import Service
from slipguard.daemon.loop.virtual_time import run_virtual
from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.run import build_service
from slipguard.devices import FINGERS
from slipguard.errors import CommandRefused, SlipguardError
from slipguard.evaluation.camera_calibration import Intrinsics
from slipguard.evaluation.lift_recording import LiftRecorder, encode_jpeg
from slipguard.evaluation.markers import GRIPPER_ID, OBJECT_ID, cells
from slipguard.evaluation.protocol import LiftProtocol, PlannedLift
from slipguard.recording import messages as m
from slipguard.sim.catalogue import find_object
from slipguard.sim.contact_label import label
from slipguard.sim.external_camera import (
    ExternalCameraModel,
    ExternalCameraRenderer,
    LensModel,
    MarkerPlate,
    MarkerScene,
)
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.scenario import scenario
from slipguard.sim.sensor_unit import random_unit
from slipguard.sim.world import World
from slipguard.sim_lifts.lift_record import IMAGE_SIGN
from slipguard.tools.waiting import running_service, wait_until

CAMERA_FPS = 30.0
CAMERA_LAG_S = (0.02, 0.09)
"""The rendered camera stamps its images on arrival, this long after the exposure; the analysis estimates this lag."""
DISTANCE_PER_HEIGHT, BOTH_MARKERS_MM = 1.6, 180.0
"""Camera distance per visible height: the lens covers 0.72 of the distance, less with tilt and roll."""
MASK_EVERY_S = 10 / 60
STATED_LATENCY_S = 0.006
GRIP_SHARE = 0.8
"""Initial grip as a share of the force needed: the object rotates about its far end, on the table."""
GRIP_MIN_N = 20.0
SETTLE_S = 0.4
TIMEOUT_S = 15.0
SUPPORT_MM = 3.0
"""The table carries part of the weight up to this height."""


@dataclass(frozen=True, slots=True)
class SimulatedLift:
    """One lift as a task for a worker process. path: its recording."""

    protocol: LiftProtocol
    lift: PlannedLift
    path: Path


def random_camera(seed: int, rise_mm: float = 100.0) -> tuple[ExternalCameraModel, float]:
    """Return a camera at a random place, far enough for a lift by `rise_mm`, and the lag of its stamps, seconds."""
    rng = np.random.default_rng([seed, 77])
    side_mm = 40.0
    camera = ExternalCameraModel(
        gripper=MarkerPlate(cells(GRIPPER_ID), side_mm, (0.0, 95.0, 3.0), roll_deg=float(rng.uniform(-8, 8))),
        object=MarkerPlate(cells(OBJECT_ID), side_mm, (70.0, 0.0, 6.0), roll_deg=float(rng.uniform(-20, 20))),
        lens=LensModel(),
        distance_mm=max(float(rng.uniform(450.0, 850.0)), DISTANCE_PER_HEIGHT * (rise_mm + BOTH_MARKERS_MM)),
        tilt_deg=float(rng.uniform(0.0, 25.0)),
        azimuth_deg=float(rng.uniform(0.0, 360.0)),
        roll_deg=float(rng.uniform(-5.0, 5.0)),
        aim_mm=(25.0, 40.0 + 0.5 * rise_mm, 0.0),
        blur_px=float(rng.uniform(0.5, 1.0)),
        noise=float(rng.uniform(1.0, 4.0)),
        light=float(rng.uniform(0.8, 1.1)),
    )
    return camera, float(rng.uniform(*CAMERA_LAG_S))


def intrinsics_of(lens: LensModel) -> Intrinsics:
    u, v = lens.center_px
    return Intrinsics(
        width_px=lens.width_px, height_px=lens.height_px, fx_px=lens.focal_px, fy_px=lens.focal_px, cx_px=u, cy_px=v,
        distortion=(lens.k1, lens.k2, 0.0, 0.0, 0.0),
    )  # fmt: skip


def record(task: SimulatedLift) -> Path:
    """Simulate one lift on a virtual clock and write its file; the same task gives the same lift."""
    log.configure(level=logging.CRITICAL)
    run_virtual(_record(task))
    return task.path


async def _record(task: SimulatedLift) -> None:
    protocol, lift = task.protocol, task.lift
    item = find_object(lift.item.name)
    grasp = scenario(lift.item.name, protocol.seed + lift.repeat)
    world = World(seed=protocol.seed + lift.number)
    height_mm = 2.0 * item.com_offset_mm * math.sin(math.radians(lift.target_deg)) + SUPPORT_MM
    with tempfile.TemporaryDirectory(prefix="slipguard-evaluate-") as folder:
        guard = {"lift_speed_mm_s": protocol.lift_speed_mm_s, "tuning": {"lower_speed_mm_s": 150.0}}
        service = build_service(
            sim_config("inline", guard=guard, state={"directory": folder}),
            world=world,
            make_worker=lambda name: FixedLatencyWorker(STATED_LATENCY_S),
        )
        async with running_service(service) as running:
            await wait_until(running, lambda: not service.waiting_for, TIMEOUT_S, "the devices are not ready")
            handlers = RequestHandlers(service)
            await handlers.submit(CalibrateRequest())
            world.place(grasp, asyncio.get_running_loop().time())
            needed_n = world.truth(asyncio.get_running_loop().time()).needed_force_n
            grip_n = lift.item.grip_force_n or protocol.grip_force_n or max(GRIP_SHARE * needed_n, GRIP_MIN_N)
            await _lift(task, service, handlers, world, running, round(grip_n, 1), height_mm)


async def _lift(
    task: SimulatedLift,
    service: Service,
    handlers: RequestHandlers,
    world: World,
    running: asyncio.Task[None],
    grip_n: float,
    height_mm: float,
) -> None:
    camera, lag_s = random_camera(task.protocol.seed + task.lift.number, height_mm)
    sign = IMAGE_SIGN[task.protocol.camera_side]
    with LiftRecorder(task.path, service, task.protocol, task.lift, intrinsics_of(camera.lens), lag_s) as file:
        if not task.protocol.guard:
            await handlers.submit(GuardRequest(on=False))
        recorders = [
            asyncio.create_task(
                _record_camera(file, world, ExternalCameraRenderer(camera, task.lift.number), lag_s, sign)
            ),
            asyncio.create_task(_record_masks(file, world)),
        ]
        try:
            await handlers.submit(GraspRequest(force_n=grip_n))
            await wait_until(
                running,
                lambda: service.ready_to_lift or service.phase is Phase.FAULT,
                TIMEOUT_S,
                "the object was not gripped",
            )
            await asyncio.sleep(SETTLE_S)
            await handlers.submit(LiftRequest(height_mm=height_mm, speed_mm_s=task.protocol.lift_speed_mm_s))
            await wait_until(running, lambda: service.phase is not Phase.LIFTING, TIMEOUT_S, "the lift did not end")
            await asyncio.sleep(task.protocol.hold_s)
        except CommandRefused as refusal:
            raise SlipguardError(f"{task.lift.stem}: {refusal}") from None
        finally:
            for recorder in recorders:
                recorder.cancel()
            await asyncio.gather(*recorders, return_exceptions=True)


async def _record_camera(
    file: LiftRecorder, world: World, renderer: ExternalCameraRenderer, lag_s: float, sign: float
) -> None:
    """Record images, stamped late, and the truth; sign: -1 from behind the right finger."""
    loop = asyncio.get_running_loop()
    at_s = loop.time()
    while True:
        truth = world.truth(at_s)
        file.truth(m.TruthRecord(at_s, truth.rotation_deg, truth.height_mm))
        scene = MarkerScene(sign * truth.rotation_deg, truth.height_mm, truth.slip_mm)
        file.camera(at_s + lag_s, encode_jpeg(renderer.draw(scene)))
        at_s += 1.0 / CAMERA_FPS
        await asyncio.sleep(at_s - loop.time())


async def _record_masks(file: LiftRecorder, world: World) -> None:
    """Record the true contact masks several times per second."""
    loop = asyncio.get_running_loop()
    cameras = {name: GelCamera(random_unit(np.random.default_rng(world.camera(name).unit_seed))) for name in FINGERS}
    while True:
        await asyncio.sleep(MASK_EVERY_S)
        for name, gel in cameras.items():
            view = world.view(name, loop.time())
            if view.depth_mm > 0.0:
                file.true_mask(name, loop.time(), label(gel.draw_with_truth(view)))
