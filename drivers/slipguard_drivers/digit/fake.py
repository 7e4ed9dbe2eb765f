"""Driver `fake` of the sensor: a fingertip camera of the simulated world, with a real camera's timing.

It exposes on an absolute schedule, stamps frames with jitter, and delivers them after a latency. It loses, repeats and
tears some. `world.faults` can make it fail: "disconnect", "stall", "frozen", "corrupt", "duplicate" (every second image
comes twice), "light" (an additional lamp), "stamps_ahead" and "stamps_behind" (a wrong clock).
"""

from __future__ import annotations

import asyncio
import math
import random
from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from slipguard.cancellation import TimerGroup
from slipguard.devices import DriverContext, Frame, TactileSensor
from slipguard.errors import DeviceLost
from slipguard.frame_stream import FrameStream
from slipguard_drivers.digit.fake_renderer import (
    GelRenderer,
    Image,
    InlineRenderer,
    ProcessRenderer,
    Renderer,
    RenderRequest,
    encode_views,
    repeat_background,
)

if TYPE_CHECKING:
    from slipguard.sim.scenario import CameraModel
    from slipguard.sim.world import World

WRONG_CLOCK_S = 5.0
LAMP_LEVELS = 60.0
"""Gray levels that the additional lamp adds to every color."""
STAMP_ERROR_MAX = 0.4
"""Largest error of a time stamp in frame periods, so that stamps never run backward."""
UNPLUGGED = "the sensor is gone (unplugged); plug it in"


class FakeSensorSettings(BaseModel):
    """draw: where images come from.

    "process" renders in a process of its own, "inline" in this one (for virtual time). "background" repeats images
    without contact, "encoded" carries the view as numbers: both are fast, for tests that evaluate no images.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    draw: Literal["process", "inline", "background", "encoded"] = "process"
    stall_ms: Annotated[float, Field(ge=50.0, le=5000.0)] = 250.0


class FakeSensor(TactileSensor):
    """One finger of the simulated world, seen through the sensor unit of its camera model."""

    Settings = FakeSensorSettings

    def __init__(self, settings: FakeSensorSettings, context: DriverContext) -> None:
        self._name = context.name
        self._world: World = context.require_world()
        self._settings = settings
        self._model: CameraModel = self._world.camera(self._name)
        self._random = random.Random(self._model.noise_seed)
        self._tears = random.Random(self._model.noise_seed)
        self._stream: FrameStream | None = None
        self._renderer = self._make_renderer(settings.draw, self._model.unit_seed)
        self._timers = TimerGroup()
        self._started_at_s = 0.0
        self._last_image: Image | None = None

    def _make_renderer(self, draw: str, unit_seed: int) -> Renderer:
        if draw == "process":
            return ProcessRenderer(self._name, unit_seed, self._lose)
        if draw == "encoded":
            return InlineRenderer(encode_views)
        if draw == "background":
            return InlineRenderer(partial(repeat_background, unit_seed))
        return InlineRenderer(lambda: GelRenderer(unit_seed).render)

    @property
    def serial(self) -> str:
        """Serial number of the simulated unit."""
        return self._model.serial

    async def open(self) -> None:
        """Start the stream; the first frame is exposed one frame period later."""
        if self._stream is not None and not self._stream.lost:
            return
        await self.close()
        if "disconnect" in self._faults():
            raise DeviceLost(f"{self._name}: no DIGIT with serial {self.serial}; plug it in")
        await self._renderer.start()
        self._stream = FrameStream(self._name, self._settings.stall_ms / 1000.0)
        self._started_at_s = asyncio.get_running_loop().time()
        self._last_image = None
        self._schedule(1)

    async def next_frame(self) -> Frame:
        """Return the newest frame that was not returned before."""
        if self._stream is None:
            raise DeviceLost(f"{self._name}: the sensor is not open; open it first")
        if "disconnect" in self._faults():
            self._lose(UNPLUGGED)
        return await self._stream.next()

    async def close(self) -> None:
        """Stop stream and renderer."""
        self._timers.cancel_all()
        self._renderer.stop()
        self._stream = None

    def _faults(self) -> frozenset[str]:
        return self._world.faults.active(self._name)

    def _lose(self, why: str) -> None:
        self._timers.cancel_all()
        if self._stream is not None:
            self._stream.lose(why)

    def _schedule(self, sequence: int) -> None:
        due_s = self._started_at_s + sequence / self._model.fps
        self._timers.call_at(due_s, lambda: self._expose(sequence))

    def _expose(self, sequence: int) -> None:
        """Take one image; exposures that a late loop has missed are lost, as in a camera."""
        now_s = asyncio.get_running_loop().time()
        model = self._update_model()
        sequence = max(sequence, math.floor((now_s - self._started_at_s) * model.fps))
        self._schedule(sequence + 1)
        faults = self._faults()
        if "disconnect" in faults:
            self._lose(UNPLUGGED)
            return
        view = self._world.view(self._name, now_s)
        lost, repeated, error = self._random.random(), self._random.random(), self._random.gauss()
        if lost < model.drop_probability or "stall" in faults:
            return
        limit_s = STAMP_ERROR_MAX / model.fps
        stamp_s = now_s + min(max(error * model.jitter_s, -limit_s), limit_s)
        stamp_s += WRONG_CLOCK_S * (("stamps_ahead" in faults) - ("stamps_behind" in faults))
        arrives_at_s = now_s + model.latency_s
        stream = self._stream
        assert stream is not None
        if "corrupt" in faults:
            self._timers.call_at(arrives_at_s, lambda: stream.damaged("only a part of its bytes arrived"))
            return

        def deliver(captured: Image) -> None:
            image, self._last_image = self._maybe_torn(captured), captured
            self._timers.call_at(arrives_at_s, lambda: stream.put(image, stamp_s, sequence))

        repeat = repeated < model.duplicate_probability or ("duplicate" in faults and sequence % 2 == 0)
        if self._last_image is not None and ("frozen" in faults or repeat):
            deliver(self._last_image)
            return
        blue, green, red = model.light_drift_bgr
        lamp = LAMP_LEVELS * ("light" in faults)
        light_bgr = (blue + lamp, green + lamp, red + lamp)
        self._renderer.render(RenderRequest(view, light_bgr, model.noise_seed), deliver)

    def _maybe_torn(self, image: Image) -> Image:
        """Return an image, or with the model's probability one whose left columns are still the last image's.

        A DIGIT reads out columns of the portrait image, and its processor may overwrite what it has not sent yet.
        """
        last, probability = self._last_image, self._model.tear_probability
        if last is None or probability == 0.0 or self._tears.random() >= probability:
            return image
        torn = image.copy()
        first = self._tears.randrange(1, image.shape[1])
        torn[:, :first] = last[:, :first]
        return torn

    def _update_model(self) -> CameraModel:
        """Return the present camera model; a new grasp restarts the random numbers."""
        model = self._world.camera(self._name)
        if model.noise_seed != self._model.noise_seed:
            self._random = random.Random(model.noise_seed)
        self._model = model
        return model
