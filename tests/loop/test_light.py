"""Light that changes while an object is gripped, with the real pipeline on rendered gels: blind is not lost."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from functools import cache, partial
from hashlib import blake2b
from itertools import cycle
from typing import Any, ClassVar

import numpy as np
import pytest
from loop_cell import Cell, on_cell
from loop_doubles import FlatSensor, NumberedImages
from numpy.typing import NDArray

from slipguard.control.reports import Fault, FaultCode
from slipguard.control.state import Phase
from slipguard.daemon.api.requests import CalibrateRequest, ClearRequest, GraspRequest, LiftRequest, LowerRequest
from slipguard.daemon.api.snapshot import health_problem, snapshot
from slipguard.daemon.store.background_images import BackgroundImage, average_background
from slipguard.devices import FINGERS
from slipguard.errors import CommandRefused
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.segmenter import Segmenter
from slipguard.sim.gel_camera import GelCamera
from slipguard.sim.gel_view import GelView
from slipguard.sim.sensor_unit import random_unit

Image = NDArray[np.uint8]
Light = Callable[[float], tuple[float, float, float]]
"""Gain of blue, green and red by the time since the light changed."""
VARIANTS = 6
"""Images with noise of their own, one after the other: enough that none repeats the last ones."""
BLIND_S = 0.5


def steady(*bgr: float) -> Light:
    gains = (bgr * 3)[:3]
    return lambda since_s: gains


def drift(since_s: float) -> tuple[float, float, float]:
    gain = max(1.0 - 0.45 * since_s, 0.1)
    return gain, gain, gain


USUAL = steady(1.0)
BAD = {f"{gain:g}": steady(gain) for gain in (0.4, 0.05, 0.0, 2.0)} | {
    "blue alone": steady(1.0, 0.0, 0.0),
    "drift": drift,
}
DARK_S = {"drift": 1.1}
"""When a light that changes slowly is at half, after which it must be reported within `BLIND_S`."""


@cache
def gel(unit: int) -> tuple[list[Image], list[Image], BackgroundImage]:
    """Images of a unit with and without contact, and its background image."""
    camera = GelCamera(random_unit(np.random.default_rng(unit)), seed=unit)
    background = average_background([camera.draw(GelView("")) for _ in range(30)], "left")
    pressed = GelView("wrench", angle_deg=30.0, depth_mm=0.6)
    return (
        [camera.draw(pressed) for _ in range(VARIANTS)],
        [camera.draw(GelView("")) for _ in range(VARIANTS)],
        background,
    )


class Network(Segmenter):
    """The shipped network, which sees each image once: the cameras repeat theirs."""

    seen: ClassVar[dict[bytes, NDArray[np.float32]]] = {}

    def segment(self, image: Image, background: Image | None) -> NDArray[np.float32]:
        assert background is not None
        key = blake2b(image, digest_size=16).digest() + blake2b(background, digest_size=16).digest()
        if key not in self.seen:
            self.seen[key] = super().segment(image, background)
        return self.seen[key]


class LitImages(NumberedImages):
    """Shows whether the object touches, in the light of the moment."""

    def __init__(self, *args: Any, unit: int) -> None:
        super().__init__(*args)
        self.unit = unit
        self.light, self.since_s = USUAL, 0.0

    def change(self, light: Light) -> None:
        self.light, self.since_s = light, asyncio.get_running_loop().time()

    def render(self, shot: Any, done: Callable[[Image], None]) -> None:
        now_s = asyncio.get_running_loop().time()
        touched, free, _ = gel(self.unit)
        self.count += 1
        image = (touched if self.world.truth(now_s).in_contact else free)[self.count % VARIANTS]
        gains = self.light(now_s - self.since_s)
        if gains == (1.0, 1.0, 1.0):
            done(image.copy())
            return
        table = np.clip(np.rint(np.outer(np.arange(256), gains)), 0, 255).astype(np.uint8)
        done(np.ascontiguousarray(np.stack([table[image[..., c], c] for c in range(3)], axis=2)))


class LitCell(Cell):
    """A cell whose fingers see rendered gels through the real pipeline, at 20 frames per second."""

    def __init__(self, watched: bool = True) -> None:
        super().__init__("wrench", guard={"first_force_n": 80.0}, fps=20.0, watched=watched)
        network = Network()
        for number, name in enumerate(FINGERS):
            sensor: FlatSensor = self.sensors[name]
            sensor.numbered_images = sensor._renderer = LitImages(self.world, unit=number)
            self.store.kept[sensor.serial] = gel(number)[2]
            self.service.fingers[name]._make_pipeline = partial(self.make_pipeline, network)

    def make_pipeline(self, network: Network, serial: str) -> Pipeline:
        known = self.store.kept[serial]
        return Pipeline(network, self.service.config.perception, known.image, known.noise_bgr, 18.5)

    def change(self, light: Light, fingers: tuple[str, ...] = FINGERS) -> None:
        for name in fingers:
            images = self.sensors[name].numbered_images
            assert isinstance(images, LitImages)
            images.change(light)

    @property
    def fault(self) -> Fault | None:
        return self.service.state.fault


async def begin(cell: LitCell, phase: Phase) -> None:
    """Bring a cell without a fault into a phase."""
    if phase is Phase.CLOSING:
        if cell.phase is not Phase.IDLE:
            await cell.release()
            await asyncio.sleep(0.7)
        await cell.submit(GraspRequest())
        return
    if cell.phase is Phase.IDLE:
        await cell.submit(GraspRequest())
    await cell.until(lambda: cell.phase is Phase.HOLDING and cell.steady())
    if phase is Phase.LIFTING:
        await cell.submit(LiftRequest(height_mm=25.0, speed_mm_s=12.0))
    if phase is Phase.LOWERING:
        await cell.submit(LiftRequest(height_mm=25.0, speed_mm_s=200.0))
        await cell.until(lambda: cell.phase is Phase.HOLDING)
        await cell.submit(LowerRequest(height_mm=25.0, speed_mm_s=12.0))


async def recover(cell: LitCell) -> None:
    """Give the usual light, wait until it is reported, and clear."""
    seen = len(cell.service.event_log.events)
    blind = [name for name in FINGERS if not cell.service.fingers[name].health.ready]
    cell.change(USUAL)
    await asyncio.sleep(0.7)
    reported = [event.text for event in list(cell.service.event_log.events)[seen:]]
    assert all(f"{name}: works again" in reported for name in blind), reported
    assert not cell.service.waiting_for
    if cell.fault is not None:
        await cell.until(lambda: cell.service.gripper.newest is not None and not cell.service.gripper.newest.moving)
        await cell.submit(ClearRequest())
        assert cell.fault is None
    await cell.until(lambda: cell.phase in (Phase.HOLDING, Phase.IDLE))


@pytest.mark.parametrize("phase", [Phase.CLOSING, Phase.HOLDING, Phase.LIFTING, Phase.LOWERING])
@on_cell(make=LitCell)
async def test_two_fingers_in_other_light_are_blind_and_the_object_is_not_lost(cell: LitCell, phase: Phase) -> None:
    await cell.ready()
    for name, light in {"usual": USUAL, **BAD}.items():
        await begin(cell, phase)
        assert cell.phase is phase
        cell.service.event_log.events.clear()
        cell.change(light)
        await asyncio.sleep(DARK_S.get(name, 0.0))
        await asyncio.sleep(BLIND_S)
        held_n = cell.truth.force_n
        fault = cell.fault
        assert (fault is not None) is (name in BAD), (name, fault)
        if fault is not None:
            assert fault.code is FaultCode.FINGERS_BLIND, (name, fault)
            assert "release" not in fault.what_to_do
            assert "left: image unusable" in fault.observed
            await asyncio.sleep(0.2)
            assert cell.fault == fault
            assert cell.truth.force_n >= held_n
            assert not any("release" in event.text for event in cell.service.event_log.events)
        await recover(cell)
        cell.service.event_log.events.clear()


@pytest.mark.parametrize("phase", [Phase.HOLDING, Phase.LIFTING])
@on_cell(make=LitCell)
async def test_one_finger_in_other_light_is_reported_and_the_other_goes_on(cell: LitCell, phase: Phase) -> None:
    await cell.ready()
    for (name, light), finger in zip(BAD.items(), cycle(FINGERS)):
        await begin(cell, phase)
        cell.change(light, (finger,))
        await asyncio.sleep(DARK_S.get(name, 0.0))
        await asyncio.sleep(BLIND_S)
        assert cell.fault is None, (name, cell.summary)
        warnings = [event.text for event in cell.service.event_log.events if event.level == "warning"]
        assert any(f"{finger}: image unusable" in text for text in warnings), (name, warnings)
        assert f"{finger}: image unusable" in (health_problem(cell.service) or "")
        assert "image unusable" in snapshot(cell.service, {}).devices[finger].reason
        await recover(cell)
        cell.service.event_log.events.clear()


LATENCY_S = 0.15
"""Of a frame at 20 fps: exposure to decision, twice the interval."""


@pytest.mark.parametrize(("light", "within_s"), [(USUAL, 0.1 + LATENCY_S), (BAD["0.05"], 0.5)])
@on_cell(make=partial(LitCell, watched=False))
async def test_a_real_loss_is_reported_in_any_light(cell: LitCell, light: Light, within_s: float) -> None:
    """In bad light by the gripper alone, once its jaws have closed."""
    await cell.ready()
    await begin(cell, Phase.LIFTING)
    await asyncio.sleep(0.3)
    cell.change(light)
    cell.world.clear(cell.now_s)
    await cell.faulted(FaultCode.OBJECT_LOST, within_s)


@on_cell(make=LitCell)
async def test_a_blind_finger_grasps_nothing_and_can_be_calibrated_in_the_new_light(cell: LitCell) -> None:
    await cell.ready()
    cell.change(BAD["0.4"], ("left",))
    await asyncio.sleep(BLIND_S)
    with pytest.raises(CommandRefused, match="cannot grasp: not ready: left: image unusable: a color's light"):
        await cell.submit(GraspRequest())
    with pytest.raises(CommandRefused, match=r"left finger cannot see whether it is in contact .*use --force"):
        await cell.handlers.calibrate(CalibrateRequest())
    await cell.handlers.calibrate(CalibrateRequest(force=True))
    await cell.ready()
    await begin(cell, Phase.HOLDING)
    assert cell.fault is None
