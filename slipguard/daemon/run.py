"""The composition root: from a configuration to a running guard, its API and its signals."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import cv2
import structlog

from slipguard import __version__
from slipguard.config import GROUP_OF, Config
from slipguard.control.step import control_step
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.paths import socket_path, token_path
from slipguard.daemon.loop.finger import PerceptionPipeline
from slipguard.daemon.loop.gel_monitor import GelMonitor
from slipguard.daemon.loop.service import FINGERS, Controller, Service
from slipguard.daemon.loop.worker import ThreadWorker, Worker
from slipguard.daemon.reload import Reloader
from slipguard.daemon.shutdown import Shutdown
from slipguard.daemon.store.calibration import BackgroundImage
from slipguard.daemon.store.last_grasp import LastGraspSaver, remembered
from slipguard.daemon.store.last_reference import ReferenceSaver, recall
from slipguard.daemon.store.recording import make_recorder, record
from slipguard.daemon.store.reference_store import REFERENCES, ReferenceStore
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import DriverContext
from slipguard.errors import DeviceTimeout, InputError
from slipguard.perception.contact.segmenter import Segmenter
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.stored_reference import ResumingPipeline
from slipguard.recording.recorder import Recorder
from slipguard.registry import load_driver
from slipguard.thread_priority import set_worker_priority
from slipguard.web.host import run_api
from slipguard.web.sockets import bind

SWITCH_S = 0.0005
"""A thread in Python code gives way after this time. Python's usual 5 ms would keep the loop waiting for a worker."""
FIRST_ANSWER_S = 10.0
log = structlog.get_logger()


def recordings_path(config: Config) -> Path:
    """Where recordings lie."""
    return config.recording.directory or StateDir(config.state.directory).path / "recordings"


def build_service(
    config: Config,
    *,
    world: object | None = None,
    make_worker: Callable[[str], Worker] = ThreadWorker,
    controller: Controller = control_step,
    around: Callable[[str, Pipeline], PerceptionPipeline] = lambda finger, pipeline: pipeline,
) -> Service:
    """Build all devices and the guard around them; touches no hardware.

    world: what the fakes share. controller: what decides. around: put around each finger's pipeline.
    Raises ConfigError or ModelError.
    """
    # Both hold for the whole process: one core for each finger, and the loop never far from its turn.
    cv2.setNumThreads(1)
    sys.setswitchinterval(SWITCH_S)
    state_dir = StateDir(config.state.directory)
    references = ReferenceStore(state_dir.path / REFERENCES)

    def device(name: str) -> Any:
        section = getattr(config, name)
        driver = load_driver(GROUP_OF[name], section.driver)
        return driver(section.settings, DriverContext(name=name, world=world, mode=config.guard.mode))

    def pipeline_maker(name: str) -> Callable[[str], PerceptionPipeline]:
        section = getattr(config, name)
        segmenter = Segmenter(config.perception.model)

        def make(serial: str) -> PerceptionPipeline:
            known = _stored_background(state_dir, serial)
            pipeline = ResumingPipeline(
                segmenter,
                config.perception,
                background=None if known is None else known.image,
                noise=None if known is None else known.noise_bgr,
                px_per_mm=section.px_per_mm,
                mounting_deg=section.mounting_deg,
                timer=time.perf_counter,
            )
            recall(pipeline, references, name, serial, asyncio.get_running_loop().time())
            return around(name, pipeline)

        return make

    return Service(
        config,
        sensors={name: device(name) for name in FINGERS},
        gripper=device("gripper"),
        arm=device("arm"),
        make_worker=make_worker,
        make_pipeline={name: pipeline_maker(name) for name in FINGERS},
        store=state_dir,
        controller=controller,
        memory=remembered(state_dir),
    )


def _stored_background(store: StateDir, serial: str) -> BackgroundImage | None:
    """The unit's image; a damaged one counts as none, so that the sensor runs and can be calibrated anew."""
    try:
        return store.load_background(serial)
    except InputError as error:
        log.error("no-contact image", why=str(error))
        return None


async def run(
    config: Config,
    *,
    world: object | None = None,
    beside: Callable[[Service], Coroutine[None, None, None]] | None = None,
    build: Callable[..., Service] = build_service,
    recorder: Callable[[Service, Path], Recorder] = make_recorder,
    reread: Callable[[], Config] | None = None,
) -> None:
    """Guard until SIGINT or SIGTERM, with the local API; the grip stays as it is at the end.

    beside: what else runs as long as the service does. build, recorder: make the service and what records it.
    reread: gives the configuration that SIGHUP asks to take up; None: SIGHUP ends the process.
    """
    service = build(config, world=world)
    kept = StateDir(config.state.directory)
    service.observers.append(LastGraspSaver(kept, service.event_log.info, service.event_log.warning).decided)
    shelf = ReferenceStore(kept.path / REFERENCES)
    service.observers.append(
        ReferenceSaver(shelf, service.fingers, service.event_log.info, service.event_log.warning).decided
    )
    desk = RequestHandlers(service)
    path = socket_path(config)
    unix = bind(path)  # before any device is opened: a second daemon must not touch what the first one owns
    log.info("slipguard starts", version=__version__, mode=config.guard.mode, socket=str(path))
    stop, hung_up, changed = asyncio.Event(), asyncio.Event(), asyncio.Event()
    loop, ending = asyncio.get_running_loop(), Shutdown()
    loop.set_default_executor(ThreadPoolExecutor(thread_name_prefix="slipguard", initializer=set_worker_priority))
    handlers = {signal.SIGINT: stop.set, signal.SIGTERM: stop.set}
    if reread is not None:
        handlers[signal.SIGHUP] = hung_up.set
    for number, handler in handlers.items():
        loop.add_signal_handler(number, handler)

    async def until_stopped() -> None:
        await stop.wait()
        ending.begin()
        raise _Stopped

    try:
        gc.collect()
        gc.freeze()  # else a full collection stops the loop for 50 ms, to look at what stays anyway
        async with asyncio.TaskGroup() as group:
            group.create_task(service.run(), name="service")
            group.create_task(
                run_api(desk, unix, config.api.address, token_path(config), service.event_log.warning), name="api"
            )
            group.create_task(until_stopped(), name="signals")
            group.create_task(GelMonitor(service).run(), name="gels")
            group.create_task(_recordings(service, desk.track_recorder(recorder), changed), name="recorder")
            if reread is not None:
                reloader = Reloader(service, reread, changed.set)
                group.create_task(_reload_on(hung_up, reloader), name="reload")
            if beside is not None:
                group.create_task(beside(service), name="beside")
    except* _Stopped:
        log.info("slipguard stops; the grip stays as it is")
    finally:
        ending.over()
        gc.unfreeze()
        for number in handlers:
            loop.remove_signal_handler(number)


async def _recordings(service: Service, make: Callable[[Service, Path], Recorder], changed: asyncio.Event) -> None:
    """Record as configured; a changed configuration begins a new file, for each must replay by the one in it."""
    while True:
        changed.clear()
        async with asyncio.TaskGroup() as group:
            recording = None
            if service.config.recording.enabled:
                recorder = make(service, recordings_path(service.config))
                recording = group.create_task(record(service, recorder), name="recording")
            await changed.wait()
            if recording is not None:
                recording.cancel()


async def _reload_on(hung_up: asyncio.Event, reloader: Reloader) -> None:
    while True:
        await hung_up.wait()
        hung_up.clear()
        await reloader.reload()


@contextlib.asynccontextmanager
async def sensors_alone(config: Config, *, look_only: bool = False) -> AsyncIterator[Service]:
    """Both sensors open and the gripper asked, without a daemon; the arm is left alone.

    look_only: what is stored is enough, so sensors whose serial numbers are known need not be there.
    Raises CommandRefused or DeviceTimeout with the reason.
    """
    service = build_service(config)
    if look_only and all(finger.sensor.serial for finger in service.fingers.values()):
        for finger in service.fingers.values():
            finger.serial = finger.sensor.serial
        try:
            yield service
        finally:
            service.close()
        return
    tasks = [asyncio.create_task(finger.run(), name=name) for name, finger in service.fingers.items()]
    tasks.append(asyncio.create_task(service.gripper.run(), name="gripper"))
    try:
        await _first_answers(service)
        yield service
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        service.close()


async def _first_answers(service: Service) -> None:
    """Until both fingers see and the gripper has answered; a gripper that is not there is no hindrance."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + FIRST_ANSWER_S
    while True:
        missing = [one.health.message for one in service.fingers.values() if not one.health.ready]
        gripper_known = service.gripper.health.ready or service.gripper.health.reason != "not tried yet"
        if not missing and gripper_known:
            return
        if loop.time() > deadline_s:
            raise DeviceTimeout("; ".join(missing) or "gripper: no answer")
        await asyncio.sleep(0.02)


class _Stopped(Exception):
    """Ends the task group on a signal."""
