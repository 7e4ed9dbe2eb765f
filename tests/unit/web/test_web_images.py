"""Images for display: the overlay on a frame, and one encoding for all clients."""

from __future__ import annotations

import asyncio
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from fake_daemon_api import FakeDaemonApi, served_on_tcp
from numpy.typing import NDArray

from slipguard.daemon.api.daemon_api import ContactOverlay, FingerFrame
from slipguard.errors import CommandRefused
from slipguard.perception.patch import ClippedSides
from slipguard.web import images as pictures_module
from slipguard.web.images import CONTOUR_BGR, SKELETON_BGR, FingerImages, draw_contact

GREY = np.full((320, 240, 3), 90, np.uint8)


def bar(angle_deg: float) -> NDArray[np.uint8]:
    """A bar of 60 x 14 in the middle of (100, 100), counter-clockwise as a viewer sees it."""
    mask = np.zeros((100, 100), np.uint8)
    corners = cv2.boxPoints(((49.5, 49.5), (60.0, 14.0), -angle_deg))
    cv2.fillPoly(mask, [np.round(corners).astype(np.int32)], (1,))
    return mask


def contact_of(mask: NDArray[np.uint8], axis_deg: float | None) -> ContactOverlay:
    return ContactOverlay(mask, 30, 50, (160, 213), ClippedSides(), axis_deg)


def points(drawn: NDArray[np.uint8], colour: tuple[int, int, int]) -> NDArray[np.float64]:
    rows, columns = np.nonzero((drawn == np.array(colour, np.uint8)).all(axis=2))
    return np.stack([columns, rows], axis=1).astype(np.float64)


@pytest.mark.parametrize("angle_deg", [0.0, 30.0, -60.0, 90.0])
def test_axis_skeleton_and_contour_lie_on_the_contact(angle_deg: float) -> None:
    drawn = draw_contact(GREY, contact_of(bar(angle_deg), angle_deg))
    middle = np.array([(30 + 50) * 1.5 - 0.5, (50 + 50) * 320 / 213 - 0.5])
    outline, skeleton = points(drawn, CONTOUR_BGR), points(drawn, SKELETON_BGR)
    assert np.abs(outline.mean(axis=0) - middle).max() < 4.0
    reach = np.hypot(*(outline - middle).T)
    assert 38.0 < reach.max() < 52.0, "the bar is 60 network pixels long, 90 of the frame"
    assert skeleton.size == 0 or np.hypot(*(skeleton - middle).T).max() < reach.max()
    red = (drawn[..., 2].astype(int) - drawn[..., 0] > 80) & (drawn[..., 1] < 140)
    rows, columns = np.nonzero(red)
    along = np.linalg.svd(np.stack([columns - columns.mean(), -(rows - rows.mean())], axis=1))[2][0]
    found_deg = np.degrees(np.arctan2(along[1], along[0]))
    assert abs((found_deg - angle_deg + 90.0) % 180.0 - 90.0) < 3.0
    assert (GREY == 90).all(), "drawn into a copy"


def test_a_contact_at_the_edge_can_be_drawn() -> None:
    mask = np.ones((213, 160), np.uint8)
    draw_contact(GREY, ContactOverlay(mask, 0, 0, (160, 213), ClippedSides(True, True, True, True), 45.0))


async def test_an_image_is_encoded_once_for_all_clients(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, drawn = FakeDaemonApi(), []

    def counting(view: FingerFrame) -> bytes:
        drawn.append(view.frame.sequence)
        return b"jpeg"

    monkeypatch.setattr(pictures_module, "encode_jpeg_with_overlay", counting)
    finger_images = FingerImages(daemon)
    found = await asyncio.gather(*(finger_images.with_overlay("left", overlay=True) for _ in range(50)))
    assert drawn == [1]
    assert {one.sequence for one in found} == {1}
    await asyncio.sleep(2 * pictures_module.OVERLAY_TTL_S)
    assert (await finger_images.with_overlay("left", overlay=True)).sequence == 2
    daemon.failure = CommandRefused("no frame of the left finger: unplugged")
    await asyncio.sleep(2 * pictures_module.OVERLAY_TTL_S)
    with pytest.raises(CommandRefused, match="unplugged"):
        await finger_images.with_overlay("left", overlay=True)
    daemon.failure = None
    assert (await finger_images.with_overlay("left", overlay=True)).sequence == 3, "a refusal is not kept"


async def test_over_http(tmp_path: Path) -> None:
    daemon = FakeDaemonApi()
    async with (
        served_on_tcp(daemon, tmp_path) as (port, _),
        httpx.AsyncClient(base_url=f"http://127.0.0.1:{port}", trust_env=False) as http,
    ):
        received = await http.get("/image/left")
        assert (received.headers["content-type"], received.headers["x-sequence"]) == ("image/jpeg", "1")
        assert received.headers["x-serial"] == "D20001"
        shown = cv2.imdecode(np.frombuffer(received.content, np.uint8), cv2.IMREAD_COLOR)
        plain = await http.get("/image/left", params={"overlay": "0"})
        bare = cv2.imdecode(np.frombuffer(plain.content, np.uint8), cv2.IMREAD_COLOR)
        assert shown.shape == bare.shape == (320, 240, 3)
        assert np.ptp(bare) < 4
        assert np.ptp(shown) > 100
        assert (await http.get("/image/middle")).status_code == 404
        assert (await http.get("/image/left", params={"overlay": "2"})).status_code == 422
        await asyncio.sleep(2 * pictures_module.OVERLAY_TTL_S)
        daemon.failure = CommandRefused("no frame of the left finger: unplugged")
        refused = await http.get("/image/left")
        assert (refused.status_code, refused.json()["error"]) == (409, str(daemon.failure))
