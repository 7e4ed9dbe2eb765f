"""The relief followed through a contact that changes: a key stands in, its doubt counts, the reference comes back."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from slipguard.lab.stress.surfaces import Heights, Lamps, Surface, contact, drawn, heights, lettered, plate
from slipguard.perception.regions import Patch, find_patch
from slipguard.perception.relief import ReliefReader
from slipguard.perception.relief_track import Followed, ReliefTrack
from slipguard.perception.texture import make_texture

BACKGROUND = np.full((320, 240, 3), 100, np.uint8)


def becoming(share: float) -> Surface:
    """Letters of which one more and more gives way to another object's edges, which turn with them."""

    def surface(u: Heights, v: Heights) -> Heights:
        return np.asarray((1.0 - share) * lettered(u, v) + share * plate(u, v), np.float32)

    return surface


class Held:
    """One contact followed frame by frame."""

    def __init__(self) -> None:
        self._reader = ReliefReader(BACKGROUND)
        self._frames = 0
        image, patch = self._shown(lettered, 0.0, (120.0, 160.0))
        self._reader.learn(image, patch)
        texture = make_texture(self._reader.read(image, patch), patch)
        assert texture is not None
        self._track = ReliefTrack(texture)
        self._last_deg = 0.0

    def see(self, surface: Surface, turn_deg: float, at: tuple[float, float] = (120.0, 160.0)) -> Followed:
        image, patch = self._shown(surface, turn_deg, at)
        found = self._track.follow(self._reader.read(image, patch), patch, self._last_deg)
        self._last_deg = self._last_deg if found.turn_deg is None else found.turn_deg
        return found

    def _shown(self, surface: Surface, turn_deg: float, at: tuple[float, float]) -> tuple[np.ndarray, Patch]:
        self._frames += 1
        height = heights(surface, 15.0 + turn_deg, at, 1.0)
        patch = find_patch(contact(height), 0.5, 100, 2.0)
        assert patch is not None
        return drawn(height, Lamps(), 2.0, np.random.default_rng(self._frames)), patch


SHARES = [0.05 * k for k in range(19)]


def test_a_contact_that_changes_is_followed_further_by_a_key(monkeypatch: pytest.MonkeyPatch) -> None:
    def told() -> list[Followed]:
        held = Held()
        return [held.see(becoming(share), 15.0 * share, (120.0 + 6 * share, 160.0)) for share in SHARES]

    with_key = told()
    monkeypatch.setattr(ReliefTrack, "_take_key", lambda *_: None)
    without = told()
    assert sum(one.turn_deg is not None for one in with_key) > sum(one.turn_deg is not None for one in without)
    for share, one in zip(SHARES, with_key, strict=True):
        if one.turn_deg is not None and one.sigma_deg is not None:
            assert abs(one.turn_deg - 15.0 * share) < max(4.0 * one.sigma_deg, 0.5)


def test_the_reference_is_taken_up_again_without_a_trace() -> None:
    held = Held()
    for share in SHARES:
        held.see(becoming(share), 0.0)
    back = [held.see(lettered, 0.0) for _ in range(3)][-1]
    assert back.turn_deg == pytest.approx(0.0, abs=0.15)
    assert back.unlike < 1.6


def test_a_changing_contact_is_less_and_less_certain() -> None:
    held = Held()
    told = [held.see(becoming(share), 0.0) for share in SHARES[:8]]
    sigmas = [one.sigma_deg for one in told if one.sigma_deg is not None]
    assert sigmas[-1] > 3.0 * sigmas[0]
    assert sum(later < before for before, later in pairwise(sigmas)) <= 2


def test_shift_is_told_in_frame_pixels() -> None:
    held = Held()
    found = [held.see(lettered, 2.0 * k, (120.0 + 2 * k, 160.0 - k)) for k in range(1, 6)][-1]
    assert found.shift_px == pytest.approx((10.0, -5.0), abs=0.5)
