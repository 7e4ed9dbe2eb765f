"""Build the daemon from a configuration and run it: the service, its API, its stores and its signals."""

from __future__ import annotations

import asyncio
import contextlib
import gc
import signal
import sys
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import structlog

from slipguard import __version__
from slipguard.config import GROUP_OF, Config
from slipguard.control.control_step import control_step
from slipguard.daemon.api.daemon_api import DaemonApi
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.paths import socket_path
from slipguard.daemon.lifecycle import Shutdown, ignore_signal
from slipguard.daemon.loop.device_health import NOT_TRIED
from slipguard.daemon.loop.finger import PerceptionPipeline
from slipguard.daemon.loop.gel_monitor import GelMonitor
from slipguard.daemon.loop.service import Controller, Service
from slipguard.daemon.loop.worker import ThreadWorker, Worker
from slipguard.daemon.reload import Reloader
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.last_config import ConfigSaver, last_config_path
from slipguard.daemon.store.last_grasp import LastGraspSaver, restore_control_state
from slipguard.daemon.store.last_reference import REFERENCES, ReferenceSaver, ReferenceStore, restore_reference
from slipguard.daemon.store.recording import make_recorder, record
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import FINGERS, DriverContext
from slipguard.errors import DeviceTimeout, InputError
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.perception.stored_reference import NO_BACKGROUND, ResumingPipeline
from slipguard.recording.recorder import Recorder
from slipguard.registry import build_device
from slipguard.thread_priority import set_worker_priority

SWITCH_S = 0.0005
"""Python threads give way after this time. Python's default of 5 ms would make the loop wait for a worker."""
FIRST_RESPONSE_S = 10.0
IGNORED = (signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM)
"""They would end the process without a word; a script that takes slipguard for another program may send them."""
log = structlog.get_logger()

ServeApi = Callable[[DaemonApi, Callable[[str], None]], Coroutine[None, None, None]]
"""Serves the API from these handlers until cancelled; the second argument receives warnings."""
BindApi = Callable[[Config], ServeApi]
"""Claims the daemon's socket. Raises SlipguardError if another daemon has it."""


def recordings_path(config: Config) -> Path:
    """Return the folder of the recordings."""
    return config.recording.directory or StateDir(config.state.directory).path / "recordings"


def build_service(
    config: Config,
    *,
    world: object | None = None,
    make_worker: Callable[[str], Worker] = ThreadWorker,
    controller: Controller = control_step,
    wrap_pipeline: Callable[[str, ResumingPipeline], PerceptionPipeline] = lambda finger, pipeline: pipeline,
) -> Service:
    """Build all devices and the service; opens no device.

    Args:
        config: The checked configuration.
        world: The simulated world that the fakes share; None on a real cell.
        make_worker: Makes the worker of each finger.
        controller: The control step.
        wrap_pipeline: Replaces or wraps each finger's pipeline.

    Raises:
        ConfigError: A driver is not available.
        ModelError: The segmentation network cannot be loaded.
    """
    # Both settings hold for the whole process: one core per finger, and the loop never waits long for a thread.
    cv2.setNumThreads(1)
    sys.setswitchinterval(SWITCH_S)
    state_dir = StateDir(config.state.directory)
    references = ReferenceStore(state_dir.path / REFERENCES)

    def device(name: str) -> Any:
        section = getattr(config, name)
        context = DriverContext(name=name, world=world, mode=config.guard.mode)
        return build_device(GROUP_OF[name], section.driver, section.settings, context)

    def pipeline_maker(name: str) -> Callable[[str], PerceptionPipeline]:
        segmenter = Segmenter(config.perception.model)

        def make(serial: str) -> PerceptionPipeline:
            known = _stored_background(state_dir, serial)
            if known is None:
                service.event_log.info(f"{name} finger ({serial}): nothing is guarded, {NO_BACKGROUND}")
            pipeline = ResumingPipeline(_build_pipeline(config, name, segmenter, known))
            restore_reference(pipeline, references, name, serial, asyncio.get_running_loop().time())
            return wrap_pipeline(name, pipeline)

        return make

    warnings: list[str] = []
    sensors = {name: device(name) for name in FINGERS}
    state = restore_control_state(state_dir, warning=warnings.append)
    service = Service(
        config,
        sensors=sensors,
        gripper=device("gripper"),
        arm=device("arm"),
        make_worker=make_worker,
        make_pipeline={name: pipeline_maker(name) for name in FINGERS},
        store=state_dir,
        controller=controller,
        control_state=state,
    )
    for line in warnings:
        service.event_log.warning(line)
    return service


def _build_pipeline(config: Config, finger: str, segmenter: Segmenter, known: BackgroundImage | None) -> Pipeline:
    """Build the pipeline of a finger. known: the unit's background image."""
    section = getattr(config, finger)
    return Pipeline(
        segmenter,
        config.perception,
        background=None if known is None else known.image,
        noise=None if known is None else known.noise_bgr,
        px_per_mm=section.px_per_mm,
        mounting_deg=section.mounting_deg,
        timer=time.perf_counter,
    )


def _stored_background(store: StateDir, serial: str) -> BackgroundImage | None:
    """Return the unit's background image; None if it is missing or damaged, so that the sensor can be calibrated."""
    try:
        return store.load_background(serial)
    except InputError as error:
        log.error("background image not used", reason=str(error))
        return None


async def run(
    config: Config,
    bind_api: BindApi,
    *,
    world: object | None = None,
    extra_task: Callable[[Service], Coroutine[None, None, None]] | None = None,
    build: Callable[..., Service] = build_service,
    recorder: Callable[[Service, Path], Recorder] = make_recorder,
    read_config: Callable[[], Config] | None = None,
    on_stop: Callable[[], object] = lambda: None,
    config_problem: str | None = None,
) -> None:
    """Guard until SIGINT or SIGTERM and serve the API; the grip stays as it is at the end.

    Args:
        config: The checked configuration.
        bind_api: Claims the socket and returns what serves the API on it (see `slipguard.cli.run`).
        world: The simulated world that the fakes share; None on a real cell.
        extra_task: Runs as long as the service does.
        build: Makes the service.
        recorder: Makes the recorder of a service.
        read_config: Reads the configuration again on SIGHUP; None: SIGHUP ends the process.
        on_stop: Called in the loop when a signal asks the daemon to stop.
        config_problem: Why `config` is not that of the file. Until a reload succeeds, it is shown, and nothing new is
            gripped, lifted or activated.
    """
    service = build(config, world=world)
    _add_savers(service, StateDir(config.state.directory), None if read_config is None else last_config_path())
    service.config_problem = config_problem
    for text in filter(None, (config_problem, config.warning)):
        service.event_log.warning(text)
    gels = GelMonitor(service)
    handlers = RequestHandlers(service, gels)
    serve_api = bind_api(config)  # before any device is opened: a second daemon must not touch the first one's devices
    log.info("slipguard starts", version=__version__, mode=config.guard.mode, socket=str(socket_path(config)))
    stop, hangup, changed = asyncio.Event(), asyncio.Event(), asyncio.Event()
    loop, shutdown = asyncio.get_running_loop(), Shutdown()
    loop.set_default_executor(ThreadPoolExecutor(thread_name_prefix="slipguard", initializer=set_worker_priority))
    signals: dict[signal.Signals, Callable[[], object]] = {signal.SIGINT: stop.set, signal.SIGTERM: stop.set}
    if read_config is not None:
        signals[signal.SIGHUP] = hangup.set

    async def until_stopped() -> None:
        await stop.wait()
        on_stop()
        shutdown.begin()
        raise _Stopped

    with _signals_handled(signals), _permanent_objects_frozen():
        try:
            async with asyncio.TaskGroup() as group:
                group.create_task(service.run(), name="service")
                group.create_task(serve_api(handlers, service.event_log.warning), name="api")
                group.create_task(until_stopped(), name="signals")
                group.create_task(gels.run(), name="gels")
                group.create_task(_record(service, recorder, handlers.watch_recorder, changed), name="recorder")
                if read_config is not None:
                    reloader = Reloader(service, read_config, changed.set)
                    group.create_task(_reload_on(hangup, reloader), name="reload")
                if extra_task is not None:
                    group.create_task(extra_task(service), name="extra")
        except* _Stopped:
            log.info("slipguard stops; the grip stays as it is")
        finally:
            shutdown.end()


@contextlib.contextmanager
def _signals_handled(handlers: Mapping[signal.Signals, Callable[[], object]]) -> Iterator[None]:
    """Call these handlers on their signals, and ignore `IGNORED`."""
    loop = asyncio.get_running_loop()
    handlers = {**handlers, **{number: partial(ignore_signal, number.name) for number in IGNORED}}
    for number, handler in handlers.items():
        loop.add_signal_handler(number, handler)
    try:
        yield
    finally:
        for number in handlers:
            loop.remove_signal_handler(number)


@contextlib.contextmanager
def _permanent_objects_frozen() -> Iterator[None]:
    """Exclude what exists now from garbage collections, which would stop the loop for 50 ms to inspect it."""
    gc.collect()
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()


def _add_savers(service: Service, state_dir: StateDir, config_path: Path | None) -> None:
    """Keep the grip, the fault, the references and the configuration on the disk, for a restart.

    config_path: None: the configuration is not kept, because it is that of a simulation or the daemon runs by hand.
    """
    info, warning = service.event_log.info, service.event_log.warning
    service.observers.append(LastGraspSaver(state_dir, info, warning).add_decision)
    references = ReferenceStore(state_dir.path / REFERENCES)
    service.observers.append(ReferenceSaver(references, service.fingers, info, warning).add_decision)
    if config_path is not None:
        service.observers.append(ConfigSaver(service, config_path, info, warning).add_decision)


async def _record(
    service: Service,
    make: Callable[[Service, Path], Recorder],
    on_new: Callable[[Recorder], None],
    changed: asyncio.Event,
) -> None:
    """Record as configured. A changed configuration starts a new file, because each file replays with its own.

    on_new: Called with each new recorder.
    """
    while True:
        changed.clear()
        async with asyncio.TaskGroup() as group:
            recording = None
            if service.config.recording.enabled:
                recorder = make(service, recordings_path(service.config))
                on_new(recorder)
                recording = group.create_task(record(service, recorder), name="recording")
            await changed.wait()
            if recording is not None:
                recording.cancel()


async def _reload_on(hangup: asyncio.Event, reloader: Reloader) -> None:
    while True:
        await hangup.wait()
        hangup.clear()
        await reloader.reload()


@contextlib.asynccontextmanager
async def sensors_without_daemon(config: Config, *, stored_only: bool = False) -> AsyncIterator[Service]:
    """Open both sensors and poll the gripper without a daemon; the arm is not used.

    stored_only: do not open sensors whose serial numbers are configured, because stored images are sufficient.
    Raises DeviceTimeout if a sensor delivers no frame.
    """
    service = build_service(config)
    fingers = service.fingers.values()
    if stored_only and all(finger.capture.sensor.serial for finger in fingers):
        for finger in fingers:
            finger.capture.assume_serial(finger.capture.sensor.serial)
        try:
            yield service
        finally:
            service.close()
        return
    tasks = [asyncio.create_task(finger.run(), name=finger.name) for finger in fingers]
    tasks.append(asyncio.create_task(service.gripper.run(), name="gripper"))
    try:
        await _first_responses(service)
        yield service
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        service.close()


async def _first_responses(service: Service) -> None:
    """Wait until both fingers have frames and the gripper was tried; a missing gripper is no obstacle."""
    loop = asyncio.get_running_loop()
    deadline_s = loop.time() + FIRST_RESPONSE_S
    while True:
        fingers, now_s = service.fingers.values(), loop.time()
        missing = [finger.health.message for finger in fingers if not finger.delivers(now_s)]
        gripper_tried = service.gripper.health.ready or service.gripper.health.reason != NOT_TRIED
        if not missing and gripper_tried:
            return
        if loop.time() > deadline_s:
            raise DeviceTimeout("; ".join(missing) or f"gripper: no response within {FIRST_RESPONSE_S:g} s")
        await asyncio.sleep(0.02)


class _Stopped(Exception):
    """Ends the task group on a signal."""
