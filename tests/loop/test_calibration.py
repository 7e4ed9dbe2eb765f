"""Background images: when they may be taken, why some are refused, that new ones are used, and older ones restored."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cell import Cell, on_cell, play
from pydantic import ValidationError

from slipguard.control.messages import ControlRequest, RequestKind
from slipguard.control.state import Phase
from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import (
    CalibrateRequest,
    GraspRequest,
    GuardRequest,
    MoveJawsRequest,
    RestoreBackgroundRequest,
)
from slipguard.daemon.store.background_images import FRAMES, BackgroundImage, average_background
from slipguard.daemon.store.state_dir import StateDir
from slipguard.devices import FRAME_SHAPE
from slipguard.errors import CommandRefused, ConfigError, InputError


def still(seed: int = 0, level: tuple[float, ...] = (100.0, 80.0, 120.0)) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    return [np.clip(rng.normal(level, 2.0, (320, 240, 3)), 0, 255).astype(np.uint8) for _ in range(FRAMES)]


def test_the_mean_and_the_noise_of_a_still_gel() -> None:
    taken = average_background(still(), "left")
    assert taken.image.shape == (320, 240, 3)
    assert abs(float(taken.image.mean()) - 100.0) < 1.0
    assert taken.noise_bgr == pytest.approx((2.0, 2.0, 2.0), abs=0.1)
    assert not taken.image.flags.writeable


def test_an_image_that_trembles_is_refused() -> None:
    images = [image + np.uint8(20 * (index % 2)) for index, image in enumerate(still())]
    with pytest.raises(CommandRefused, match=r"left: the image is not still \(noise"):
        average_background(images, "left")


@pytest.mark.parametrize("frames", [range(20, 30), range(12, 18), range(8)])
def test_a_touch_at_any_time_is_refused(frames: range) -> None:
    images = still()
    for index in frames:
        images[index][150:200, 100:140] -= np.uint8(30)
    with pytest.raises(CommandRefused, match="right: something touched the gel"):
        average_background(images, "right")


@pytest.mark.parametrize(
    ("level", "why"),
    [((90.0, 90.0, 90.0), "a gray image: check the stream's format"), ((9.0, 5.0, 12.0), "mean of 9 gray levels")],
)
def test_an_image_without_color_or_light_is_refused(level: tuple[float, ...], why: str) -> None:
    with pytest.raises(CommandRefused, match=rf"left: image unusable: .*{why}.*; nothing was stored"):
        average_background(still(level=level), "left")


def uncalibrated() -> Cell:
    return Cell(calibrated=False)


@on_cell(make=uncalibrated)
async def test_it_is_needed_before_the_first_grasp_and_used_from_then_on(cell: Cell) -> None:
    await cell.ready()
    with pytest.raises(CommandRefused, match=r"left finger \(SIM-L\) has no background image; run `slipguard cal"):
        await cell.submit(GraspRequest())
    taken = await cell.handlers.calibrate(CalibrateRequest())
    assert sorted(taken) == ["left", "right"]
    assert sorted(cell.store.kept) == ["SIM-L", "SIM-R"]
    assert cell.store.kept["SIM-L"] is taken["left"]
    assert {name: len(made) for name, made in cell.perceivers.items()} == {"left": 2, "right": 2}
    for name, finger in cell.service.fingers.items():
        assert finger.pipeline is cell.perceivers[name][-1]
        assert finger.newest is not None
    await cell.grasp()


@on_cell()
async def test_it_is_refused_while_something_is_or_may_be_touched(cell: Cell) -> None:
    await cell.ready()
    await cell.submit(GraspRequest())
    with pytest.raises(CommandRefused, match="cannot calibrate while closing; support the object, then release it"):
        await cell.submit(CalibrateRequest())
    await cell.until(cell.steady)
    with pytest.raises(CommandRefused, match="cannot calibrate while holding; support the object, then release it"):
        await cell.submit(CalibrateRequest())
    await cell.release()
    cell.world.clear(cell.now_s)
    await cell.submit(GraspRequest())
    await cell.until(lambda: cell.phase is Phase.IDLE)
    with pytest.raises(CommandRefused, match="open the jaws"):
        await cell.submit(CalibrateRequest())
    await cell.release()
    await asyncio.sleep(0.2)
    assert sorted(await cell.handlers.calibrate(CalibrateRequest())) == ["left", "right"]


@pytest.mark.parametrize("kind", ["disconnect", "stall"])
@on_cell(make=uncalibrated)
async def test_without_frames_it_is_refused(cell: Cell, kind: str) -> None:
    await cell.ready()
    asked = asyncio.create_task(cell.submit(CalibrateRequest()))
    await asyncio.sleep(0.1)
    cell.world.faults.fail("right", kind)
    with pytest.raises(CommandRefused, match=r"right: received \d+ of 30 frames within 5 s"):
        await asked
    with pytest.raises(CommandRefused, match="no frames from right"):
        await cell.submit(CalibrateRequest())
    assert cell.store.kept == {}


@on_cell()
async def test_nothing_may_close_while_it_goes_on(cell: Cell) -> None:
    await cell.ready()
    asked = asyncio.create_task(cell.submit(CalibrateRequest()))
    await asyncio.sleep(0.1)
    for request in (
        cell.submit(GraspRequest()),
        cell.submit(MoveJawsRequest(width_mm=0.0, force_n=30.0)),
        cell.submit(CalibrateRequest()),
    ):
        with pytest.raises(CommandRefused, match="a calibration is running"):
            await request
    await asked
    await cell.grasp()


@on_cell()
async def test_a_damaged_image_is_a_reason_not_to_grasp(cell: Cell) -> None:
    def damaged(serial: str) -> BackgroundImage | None:
        raise InputError("no_contact-0001.png: cannot be read; run `slipguard calibrate`")

    await cell.ready()
    cell.store.load_background = damaged  # type: ignore[method-assign]
    with pytest.raises(CommandRefused, match="cannot be read; run `slipguard calibrate`"):
        await cell.submit(GraspRequest())


@pytest.mark.parametrize(
    ("room", "stored", "reason"),
    [(0, {}, "of left .*; nothing was stored"), (1, {"left": 1}, "of right .*; the new image of left is in use")],
)
@on_cell()
async def test_a_full_disk_is_reported_with_the_stored_images_which_stay_in_use(
    cell: Cell, room: int, stored: dict[str, int], reason: str
) -> None:
    await cell.ready()
    really_save, asked = cell.store.save_background, list[str]()

    def save(serial: str, taken: BackgroundImage, *, new_gel: bool = False) -> None:
        asked.append(serial)
        if len(asked) > room:
            raise ConfigError("no_contact-0002.png: cannot be written (No space left on device)")
        really_save(serial, taken)

    before, made = dict(cell.store.kept), {name: len(one) for name, one in cell.perceivers.items()}
    cell.store.save_background = save  # type: ignore[method-assign]
    with pytest.raises(CommandRefused, match=reason):
        await cell.submit(CalibrateRequest())
    await asyncio.sleep(0.5)
    used = {name: len(one) - made[name] for name, one in cell.perceivers.items() if len(one) > made[name]}
    assert used == stored
    new = [serial for serial, one in cell.store.kept.items() if one is not before.get(serial)]
    assert new == ["SIM-L"][:room]


def taken(level: int) -> BackgroundImage:
    return BackgroundImage(np.full(FRAME_SHAPE, level, np.uint8), (2.0, 2.0, 2.0), 30)


def with_history(tmp_path: Path, scene: Callable[[Cell, RequestHandlers, StateDir], Coroutine[Any, Any, None]]) -> None:
    """Both sensors have been calibrated twice."""
    store = StateDir(tmp_path)
    for serial in ("SIM-L", "SIM-R"):
        for level in (50, 60):
            store.save_background(serial, taken(level))

    async def main(cell: Cell) -> None:
        cell.service.store = store
        await cell.ready()
        await scene(cell, RequestHandlers(cell.service), store)

    play(Cell(), main)


def test_an_older_one_is_put_to_use_again_and_the_pipeline_built_with_it(tmp_path: Path) -> None:
    async def scene(cell: Cell, handlers: RequestHandlers, store: StateDir) -> None:
        response = await handlers.submit(RestoreBackgroundRequest(finger="left", number=1))
        assert response == {"message": "left (SIM-L): background image 1 is in use again"}
        known = store.load_background("SIM-L")
        assert known is not None
        assert int(known.image[0, 0, 0]) == 50
        assert {name: len(made) for name, made in cell.perceivers.items()} == {"left": 2, "right": 1}
        with pytest.raises(CommandRefused, match="background image 9 not found"):
            await handlers.submit(RestoreBackgroundRequest(finger="left", number=9))
        with pytest.raises(ValidationError):
            RestoreBackgroundRequest.model_validate({"finger": "thumb", "number": 1})

    with_history(tmp_path, scene)


@on_cell(guard={"mode": "guard"})
async def test_it_is_refused_while_the_gripper_is_held_by_another_program(cell: Cell) -> None:
    await cell.ready()
    await cell.submit(GuardRequest(on=False))
    await cell.submit(MoveJawsRequest(width_mm=0.0, force_n=30.0))
    await cell.until(lambda: cell.truth.in_contact)
    await asyncio.sleep(1.0)
    assert cell.phase is Phase.IDLE
    with pytest.raises(CommandRefused, match="is moving, holding or closed; support what it holds, then open the jaws"):
        await cell.submit(CalibrateRequest())


@on_cell(make=uncalibrated)
async def test_nothing_is_stored_if_something_is_gripped_meanwhile(cell: Cell) -> None:
    await cell.ready()
    asked = asyncio.create_task(cell.submit(CalibrateRequest()))
    await asyncio.sleep(0.1)
    await cell.service.request(ControlRequest(RequestKind.GRASP))
    with pytest.raises(CommandRefused, match="cannot calibrate while"):
        await asked
    assert cell.store.kept == {}


def test_no_older_one_is_put_to_use_while_something_is_held(tmp_path: Path) -> None:
    async def scene(cell: Cell, handlers: RequestHandlers, store: StateDir) -> None:
        await cell.grasp()
        with pytest.raises(CommandRefused, match="cannot calibrate while holding; support the object, then release it"):
            await handlers.submit(RestoreBackgroundRequest(finger="left", number=1))
        assert len(store.background_versions("SIM-L")) == 2

    with_history(tmp_path, scene)
