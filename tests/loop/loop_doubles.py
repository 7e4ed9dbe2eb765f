"""Stand-ins for a cell on the virtual clock: images that cost nothing, a perceiver that knows the truth, devices
that log their commands, a store and a worker without disk and threads.

The sensor delivers on the fake's own schedule, with its latency, losses, repetitions and faults, but shows one flat
color: a number under which the truth at the moment of exposure is kept. The perceiver looks the truth up and adds
seeded noise.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from slipguard.daemon.loop.worker import FixedLatencyWorker
from slipguard.daemon.store.background_images import BackgroundImage, BackgroundVersion
from slipguard.devices import FRAME_SHAPE, DriverContext, Frame
from slipguard.errors import InputError
from slipguard.perception.estimate import Estimate
from slipguard.sim.cell import WorldTruth
from slipguard.sim.world import World
from slipguard_drivers.digit.fake import FakeSensor
from slipguard_drivers.digit.fake_renderer import RenderRequest
from slipguard_drivers.robotiq.fake import FakeGripper
from slipguard_drivers.ur5.fake import FakeArm

SIGMA_DEG = 0.4
NOISE_MM = 0.03
STABLE_FRAMES = 5
SWING_DEG_S = 25.0
GEL_ROW = np.array([90, 60, 120], np.uint8) + np.arange(240, dtype=np.uint8)[:, None] // 4
"""A row of a gel's image: three colors, and a glow that changes along it."""
ALPHA, BETA = 0.5, 0.15  # rotation and rate gain of the tracker's filter
Image = NDArray[np.uint8]


@dataclass
class NumberedImages:
    """Truths by the number that a flat image shows."""

    world: World
    count: int = 0
    shown: dict[int, WorldTruth] = field(default_factory=dict)
    flickers: bool = False

    async def start(self) -> None:
        """Do nothing: nothing is loaded."""

    def render(self, shot: RenderRequest, done: Callable[[Image], None]) -> None:
        self.count += 1
        self.shown[self.count] = self.world.truth(asyncio.get_running_loop().time())
        self.shown.pop(self.count - 100, None)
        row = GEL_ROW + np.uint8(60 * (self.count % 2) if self.flickers else 0)
        row[0] = tuple(self.count.to_bytes(3, "little"))
        done(np.broadcast_to(row, FRAME_SHAPE))

    def truth(self, image: Image) -> WorldTruth:
        return self.shown[int.from_bytes(image[0, 0].tobytes(), "little")]

    def stop(self) -> None:
        """Do nothing: no resource is held."""


class FlatSensor(FakeSensor):
    """The fake sensor with images that cost nothing."""

    def __init__(self, context: DriverContext) -> None:
        super().__init__(FakeSensor.Settings(draw="inline"), context)
        self.numbered_images = NumberedImages(self._world)
        self._renderer = self.numbered_images
        self.opened = 0

    async def open(self) -> None:
        self.opened += 1
        await super().open()


class Oracle:
    """A perceiver that knows the truth, with noise and reference as the real one has, and which may decline.

    always_touched: it sees contact where there is none. swings_since_s: it sees the object rotate, though it rests.
    """

    def __init__(
        self, numbered_images: NumberedImages, sign: float, rng: np.random.Generator, declined: str | None
    ) -> None:
        self.numbered_images, self.sign, self.rng, self.declined = numbered_images, sign, rng, declined
        self.always_touched = False
        self.swings_since_s: float | None = None
        self.last_patch = None
        self.sequence = 0
        self.reset_reference()

    def keep_estimate(self, captured_at_s: float) -> None:
        return

    def reset_reference(self) -> None:
        self.stable = 0
        self.reference: tuple[float, float] | None = None
        self.track = (0.0, 0.0)
        self.tracked_s = 0.0

    def process(self, frame: Frame) -> Estimate:
        truth, now_s = self.numbered_images.truth(frame.image), frame.captured_at_s
        self.sequence = frame.sequence
        touched = truth.in_contact or self.always_touched
        plain = Estimate(frame.sequence, now_s, now_s, touched, 4000 * touched, "oracle")
        if not touched:
            self.stable = 0
            return replace(plain, skipped="no contact", declined="no contact")
        rotation_deg = self.sign * truth.rotation_deg + self.rng.normal(0.0, SIGMA_DEG)
        if self.swings_since_s is not None:
            rotation_deg += self.sign * SWING_DEG_S * (now_s - self.swings_since_s)
        slip_mm = truth.slip_mm + self.rng.normal(0.0, NOISE_MM)
        self.stable += 1
        if self.reference is None:
            if self.stable < STABLE_FRAMES:
                return replace(plain, declined="no reference yet")
            self.reference, self.tracked_s = (rotation_deg, slip_mm), now_s
        shift_mm = (0.0, self.reference[1] - slip_mm)
        if self.declined is not None:
            return replace(plain, shift_mm=shift_mm, declined=self.declined)
        rotation_deg -= self.reference[0]
        passed_s = max(now_s - self.tracked_s, 1e-3)
        value, rate = self.track[0] + self.track[1] * passed_s, self.track[1]
        self.track = (value + ALPHA * (rotation_deg - value), rate + BETA * (rotation_deg - value) / passed_s)
        self.tracked_s = now_s
        return replace(
            plain, rotation_deg=rotation_deg, sigma_deg=SIGMA_DEG, orientation_deg=0.0,
            rate_deg_s=self.track[1], shift_mm=shift_mm,
        )  # fmt: skip


class LoggedGripper(FakeGripper):
    """The fake gripper with a log of its commands. The next commands raise `failures` instead, one each."""

    def __init__(self, context: DriverContext, fingertip_mm: float = 0.0) -> None:
        super().__init__(FakeGripper.Settings(fingertip_mm=fingertip_mm), context)
        self.commands: list[tuple[float, str, float]] = []
        self.failures: list[Exception] = []

    async def hold(self, force_n: float) -> float:
        self._note("hold", force_n)
        return await super().hold(force_n)

    async def move(self, width_mm: float, force_n: float) -> float:
        self._note("move", width_mm)
        return await super().move(width_mm, force_n)

    async def halt(self) -> None:
        self._note("halt", 0.0)
        await super().halt()

    async def release(self, width_mm: float) -> None:
        self._note("release", width_mm)
        await super().release(width_mm)

    def _note(self, what: str, value: float) -> None:
        self.commands.append((asyncio.get_running_loop().time(), what, value))
        if self.failures:
            raise self.failures.pop(0)


class LoggedArm(FakeArm):
    """The fake arm with a log of its commands."""

    def __init__(self, context: DriverContext) -> None:
        super().__init__(FakeArm.Settings(), context)
        self.commands: list[tuple[float, str, float]] = []

    async def lift(self, height_mm: float, speed_mm_s: float) -> float:
        self.commands.append((asyncio.get_running_loop().time(), "lift", height_mm))
        return await super().lift(height_mm, speed_mm_s)

    async def stop(self) -> None:
        self.commands.append((asyncio.get_running_loop().time(), "stop", 0.0))
        await super().stop()


class Memory:
    """A store of background images in memory."""

    def __init__(self, *serials: str) -> None:
        blank = np.zeros(FRAME_SHAPE, np.uint8)
        self.kept = {serial: BackgroundImage(blank, (2.0, 2.0, 2.0), 30) for serial in serials}

    def load_background(self, serial: str, number: int | None = None) -> BackgroundImage | None:
        return self.kept.get(serial)

    def first_of_gel(self, serial: str) -> BackgroundImage | None:
        return self.kept.get(serial)

    def save_background(self, serial: str, taken: BackgroundImage, *, new_gel: bool = False) -> None:
        self.kept[serial] = taken

    def restore_background(self, serial: str, number: int) -> None:
        raise InputError(f"{serial}: older images are not kept here")

    def background_versions(self, serial: str) -> list[BackgroundVersion]:
        return []


class ClosableWorker(FixedLatencyWorker):
    """A worker of stated latency that knows whether it was closed."""

    closed = False

    def close(self) -> None:
        self.closed = True
