"""A finger without a background image reports contact, but no rotation, and the reason says what to do."""

from __future__ import annotations

import asyncio
from pathlib import Path

import pytest
from blue_contact import BACKGROUND, ReadsBlue, frame
from drawn_masks import drawn

from slipguard.config import parse_config
from slipguard.daemon import run as daemon_run
from slipguard.daemon.loop.finger import Finger
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.state_dir import StateDir
from slipguard.perception.estimate import Estimate
from slipguard.sim.world import World, WorldSettings


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> StateDir:
    monkeypatch.setattr(daemon_run, "Segmenter", lambda model: ReadsBlue())
    return StateDir(tmp_path)


def held_bar(state: StateDir) -> tuple[Estimate, list[str]]:
    """Return the left finger's estimate of a bar that it has held for a while, and the events since the start."""

    async def main() -> tuple[Estimate, list[str]]:
        config = parse_config({"state": {"directory": str(state.path)}}, where="test", sim=True)
        service = daemon_run.build_service(config, world=World(WorldSettings(), seed=0))
        try:
            finger: Finger = service.fingers["left"]
            finger.capture.assume_serial("SIM-L")
            finger.renew_pipeline()
            assert finger.pipeline is not None
            for k in range(10):
                estimate = finger.pipeline.process(frame(drawn("long bar", 20.0), k))
            return estimate, [event.text for event in service.event_log.events]
        finally:
            service.close()

    return asyncio.run(main())


def test_without_a_background_image_nothing_is_guarded(state: StateDir) -> None:
    estimate, events = held_bar(state)
    assert estimate.contact
    assert (estimate.rotation_deg, estimate.shift_mm, estimate.has_reference) == (None, None, False)
    assert estimate.declined == "no background image: run `slipguard calibrate` with the jaws open and empty"
    assert [text for text in events if "left finger (SIM-L): nothing is guarded, no background image: run" in text]


def test_with_a_background_image_it_is_guarded(state: StateDir) -> None:
    state.save_background("SIM-L", BackgroundImage(BACKGROUND, (1.0, 1.0, 1.0), 30))
    estimate, events = held_bar(state)
    assert estimate.has_reference
    assert estimate.decline_reason != "no background image"
    assert not [text for text in events if "nothing is guarded" in text]
