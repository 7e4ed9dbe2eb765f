"""Older background images: listed, shown and restored, and when that is refused."""

from __future__ import annotations

import json
import threading
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from loop_cell import Cell, play
from loop_doubles import SHAPE
from pydantic import ValidationError

from slipguard.daemon.api.handlers import RequestHandlers
from slipguard.daemon.api.requests import CalibrateRequest, RestoreBackgroundRequest
from slipguard.daemon.store.background_images import BackgroundImage, BackgroundVersion
from slipguard.daemon.store.state_dir import StateDir
from slipguard.errors import CommandRefused


def taken(level: int) -> BackgroundImage:
    return BackgroundImage(np.full(SHAPE, level, np.uint8), (2.0, 2.0, 2.0), 30)


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


def test_all_that_is_stored_is_listed(tmp_path: Path) -> None:
    async def scene(cell: Cell, handlers: RequestHandlers, store: StateDir) -> None:
        listed = json.loads(await handlers.backgrounds())
        assert {name: one["serial"] for name, one in listed.items()} == {"left": "SIM-L", "right": "SIM-R"}
        assert [one["number"] for one in listed["left"]["versions"]] == [1, 2]
        assert listed["left"]["versions"][1]["level_bgr"] == [60.0, 60.0, 60.0]
        newest, first = await handlers.background("left"), await handlers.background("left", 1)
        assert (newest.serial, newest.frame.sequence, int(newest.frame.image[0, 0, 0])) == ("SIM-L", 2, 60)
        assert (first.frame.sequence, int(first.frame.image[0, 0, 0])) == (1, 50)
        with pytest.raises(CommandRefused, match="SIM-L: background image 7 not found; stored numbers: 1, 2"):
            await handlers.background("left", 7)
        with pytest.raises(CommandRefused, match="no finger 'thumb'; choose from: left, right"):
            await handlers.background("thumb")

    with_history(tmp_path, scene)


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


def test_not_while_something_is_held(tmp_path: Path) -> None:
    async def scene(cell: Cell, handlers: RequestHandlers, store: StateDir) -> None:
        await cell.grasp()
        with pytest.raises(CommandRefused, match="cannot calibrate while holding; support the object, then release it"):
            await handlers.submit(RestoreBackgroundRequest(finger="left", number=1))
        assert len(store.background_versions("SIM-L")) == 2

    with_history(tmp_path, scene)


@pytest.mark.parametrize("new_gel", [False, True])
def test_a_calibration_says_whether_the_gel_is_new(tmp_path: Path, new_gel: bool) -> None:
    async def scene(cell: Cell, handlers: RequestHandlers, store: StateDir) -> None:
        await handlers.submit(CalibrateRequest(new_gel=new_gel))
        newest = store.background_versions("SIM-R")[-1]
        assert (newest.number, newest.new_gel) == (3, new_gel)
        first = store.first_of_gel("SIM-R")
        assert first is not None
        assert (int(first.image[100, 100, 0]) == 50) is not new_gel

    with_history(tmp_path, scene)


def test_a_sensor_that_was_not_opened_has_no_versions() -> None:
    async def scene(cell: Cell) -> None:
        handlers = RequestHandlers(cell.service)
        assert json.loads(await handlers.backgrounds())["left"] == {"serial": None, "versions": []}
        with pytest.raises(CommandRefused, match="left finger: no sensor was found yet"):
            await handlers.submit(RestoreBackgroundRequest(finger="left", number=1))
        await cell.ready()
        assert json.loads(await handlers.backgrounds())["left"] == {"serial": "SIM-L", "versions": []}

    play(Cell(), scene)


async def test_what_is_stored_is_read_in_a_thread_of_its_own(tmp_path: Path) -> None:
    """A client that reads images must not delay the threads that decode frames and command the gripper."""
    threads: set[str] = set()

    class Noting(StateDir):
        def background_versions(self, serial: str) -> list[BackgroundVersion]:
            threads.add(threading.current_thread().name)
            return super().background_versions(serial)

        def load_background(self, serial: str, number: int | None = None) -> BackgroundImage | None:
            threads.add(threading.current_thread().name)
            return super().load_background(serial, number)

    store = Noting(tmp_path)
    store.save_background("SIM-L", taken(50))
    threads.clear()
    handlers = RequestHandlers(Cell().service)
    handlers._service.store = store
    handlers._service.fingers["left"].capture.assume_serial("SIM-L")
    assert [one["number"] for one in json.loads(await handlers.backgrounds())["left"]["versions"]] == [1]
    assert (await handlers.background("left")).frame.sequence == 1
    assert threads == {"slipguard-images_0"}
