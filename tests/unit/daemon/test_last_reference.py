"""The reference of the rotation survives the daemon: kept while an object is held, tried by the next one, forgotten."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from blue_contact import BACKGROUND, ReadsBlue, frame
from drawn_masks import drawn

from slipguard.atomic_file import write_atomically as really_write
from slipguard.control.state import Phase
from slipguard.daemon.store.dated_file import VALID_FOR
from slipguard.daemon.store.last_reference import ReferenceSaver, ReferenceStore, restore_reference
from slipguard.errors import InputError
from slipguard.perception.pipeline import Pipeline
from slipguard.perception.settings import PerceptionSettings
from slipguard.perception.stored_reference import ResumingPipeline, StoredReference
from slipguard.tools.waiting import wait_until

IMAGE = np.random.default_rng(1).integers(0, 255, (320, 240, 3), np.uint8)


def pipeline() -> ResumingPipeline:
    return ResumingPipeline(Pipeline(ReadsBlue(), PerceptionSettings(), BACKGROUND, (1.0, 1.0, 1.0), 18.5))


class Finger:
    """What the saver reads of a finger: its pipeline and its newest estimate."""

    def __init__(self, pipe: ResumingPipeline) -> None:
        self.pipeline, self.serial, self.newest, self.count = pipe, "D1", None, 0

    def sees(self, angle_deg: float, frames: int = 6) -> None:
        for _ in range(frames):
            self.count += 1
            answer = self.pipeline.process(frame(drawn("key", angle_deg), self.count))
            self.newest = SimpleNamespace(estimate=answer)  # type: ignore[assignment]


def decision(phase: Phase, holding: bool = True, now_s: float = 0.0) -> Any:
    observation = SimpleNamespace(gripper=SimpleNamespace(holding=holding))
    return SimpleNamespace(phase=phase, observation=observation, now_s=now_s)


async def settled(saver: ReferenceSaver, *decisions: Any) -> None:
    """However long the disk takes."""
    for one in decisions:
        saver.add_decision(one)
        await wait_until(None, lambda: not saver._disk.busy, 60.0, "the disk does not get done")


async def test_a_reference_that_is_held_for_hours_stays_valid(tmp_path: Path) -> None:
    finger = Finger(pipeline())
    saver = ReferenceSaver(ReferenceStore(tmp_path), {"left": finger}, [].append, [].append)  # type: ignore[dict-item]
    finger.sees(20.0, frames=12)
    saved_at = []
    for minutes in range(0, 21, 4):
        await settled(saver, decision(Phase.HOLDING, now_s=60.0 * minutes))
        saved_at.append(json.loads((tmp_path / "left.json").read_text())["saved_at"])
    assert [one != before for before, one in pairwise(saved_at)] == [False, True, False, True, False]


async def test_a_restart_continues_with_the_reference_and_reports_it(tmp_path: Path) -> None:
    reported: list[str] = []
    old = Finger(pipeline())
    saver = ReferenceSaver(ReferenceStore(tmp_path), {"left": old}, reported.append, reported.append)  # type: ignore[dict-item]
    old.sees(0.0)
    await settled(saver, decision(Phase.HOLDING))
    old.sees(12.0)
    await settled(saver, decision(Phase.HOLDING), decision(Phase.HOLDING))
    written = json.loads((tmp_path / "left.json").read_text())
    assert written["rotation_deg"] == pytest.approx(12.0, abs=0.5)

    new = Finger(pipeline())
    restore_reference(new.pipeline, ReferenceStore(tmp_path), "left", "D1", 0.0)
    assert new.pipeline.stored_reference_state == "waiting"
    saver = ReferenceSaver(ReferenceStore(tmp_path), {"left": new}, reported.append, reported.append)  # type: ignore[dict-item]
    new.sees(15.0)
    await settled(saver, decision(Phase.REFERENCE), decision(Phase.HOLDING))
    assert new.newest.estimate.rotation_deg == pytest.approx(15.0, abs=0.5)  # type: ignore[attr-defined]
    assert reported == ["left finger: continues with the reference from before the restart"]
    assert json.loads((tmp_path / "left.json").read_text())["rotation_deg"] == pytest.approx(15.0, abs=0.5)

    await settled(saver, decision(Phase.IDLE, holding=False))
    assert ReferenceStore(tmp_path).load("left", "D1") is None


async def test_a_different_contact_is_reported_with_the_earlier_rotation(tmp_path: Path) -> None:
    reported: list[str] = []
    ReferenceStore(tmp_path).save("left", "D1", StoredReference(IMAGE, 12.0))
    finger = Finger(pipeline())
    restore_reference(finger.pipeline, ReferenceStore(tmp_path), "left", "D1", 0.0)
    saver = ReferenceSaver(ReferenceStore(tmp_path), {"left": finger}, reported.append, reported.append)  # type: ignore[dict-item]
    finger.sees(0.0, 20)
    await settled(saver, decision(Phase.HOLDING), decision(Phase.HOLDING))
    assert len(reported) == 1
    assert "continues from 12° with a new reference" in reported[0]
    written = json.loads((tmp_path / "left.json").read_text())
    assert (written["rotation_deg"], written["earlier_rotation_deg"]) == (pytest.approx(0.0, abs=0.5), 12.0)


async def test_the_rotation_before_a_growing_contacts_reference_is_stored_apart(tmp_path: Path) -> None:
    finger = Finger(pipeline())
    for k in range(40):
        shape = drawn("bar", 20.0 + 0.5 * max(k - 5, 0), scale=0.4 + 0.02 * k)
        finger.newest = SimpleNamespace(estimate=finger.pipeline.process(frame(shape, k)))  # type: ignore[assignment]
    saver = ReferenceSaver(ReferenceStore(tmp_path), {"left": finger}, [].append, [].append)  # type: ignore[dict-item]
    await settled(saver, decision(Phase.HOLDING))
    known = ReferenceStore(tmp_path).load("left", "D1")
    assert known is not None
    assert known.earlier_rotation_deg == pytest.approx(finger.pipeline.carried_deg)
    assert known.earlier_rotation_deg > 1.0
    assert known.rotation_deg + known.earlier_rotation_deg == pytest.approx(16.5, abs=0.5)


async def test_references_are_saved_again_on_a_repaired_disk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("slipguard.daemon.store.disk_writer.RETRY_S", 3600.0)
    disk = {"full": True, "writes": 0}

    def write_atomically(path: Path, content: bytes) -> None:
        disk["writes"] += 1
        if disk["full"]:
            raise OSError(28, "No space left on device")
        really_write(path, content)

    monkeypatch.setattr("slipguard.daemon.store.last_reference.write_atomically", write_atomically)
    reported: list[str] = []
    finger = Finger(pipeline())
    saver = ReferenceSaver(ReferenceStore(tmp_path), {"left": finger}, reported.append, reported.append)  # type: ignore[dict-item]
    finger.sees(0.0)
    await settled(saver, *[decision(Phase.HOLDING)] * 2)
    assert disk["writes"] == 1, "not at once again"
    disk["full"] = False
    saver._disk._retry_at_s = 0.0  # the pause is over
    await settled(saver, *[decision(Phase.HOLDING)] * 4)
    known = ReferenceStore(tmp_path).load("left", "D1")
    assert known is not None
    assert reported == [
        "the references could not be saved for a restart: No space left on device; check the disk",
        "the references can be saved for a restart again",
    ]
    disk["full"] = True
    await settled(saver, *[decision(Phase.IDLE, holding=False)] * 2)
    assert ReferenceStore(tmp_path).load("left", "D1") is None, "deleting needs no room"


def test_a_rotation_is_never_stored_with_the_image_of_another_reference(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = ReferenceStore(tmp_path)
    store.save_rotation("left", "D1", StoredReference(IMAGE, 7.0))  # never saved before: as if it were
    new = StoredReference(IMAGE[::-1].copy(), 0.0)
    with monkeypatch.context() as failing:
        failing.setattr("slipguard.daemon.store.last_reference.write_atomically", fails)
        with pytest.raises(OSError, match="No space left"):
            store.save("left", "D1", new)
    old = ReferenceStore(tmp_path).load("left", "D1")
    assert old is not None
    assert (old.rotation_deg, np.array_equal(old.image, IMAGE)) == (7.0, True)
    store.save_rotation("left", "D1", new)
    known = ReferenceStore(tmp_path).load("left", "D1")
    assert known is not None
    assert (known.rotation_deg, np.array_equal(known.image, new.image)) == (0.0, True)


def fails(path: Path, content: bytes) -> None:
    raise OSError(28, "No space left on device")


def test_a_reference_is_valid_for_the_same_sensor_and_for_an_hour(tmp_path: Path) -> None:
    store = ReferenceStore(tmp_path)
    store.save("left", "D1", StoredReference(IMAGE, 7.0, 1.0))
    known = ReferenceStore(tmp_path).load("left", "D1")
    assert known is not None
    assert np.array_equal(known.image, IMAGE)
    assert (known.rotation_deg, known.earlier_rotation_deg) == (7.0, 1.0)
    assert store.load("left", "D2") is None
    assert store.load("right", "D1") is None
    assert store.load("left", "D1", datetime.now(UTC) + VALID_FOR + timedelta(seconds=1)) is None


@pytest.mark.parametrize("damage", ["no json", "half an image", "an empty image", "no image", "another image"])
def test_a_damaged_reference_is_not_used(tmp_path: Path, damage: str) -> None:
    store = ReferenceStore(tmp_path)
    store.save("left", "D1", StoredReference(IMAGE, 7.0))
    png = tmp_path / "left.png"
    if damage == "no json":
        (tmp_path / "left.json").write_text("{")
    elif damage == "half an image":
        png.write_bytes(png.read_bytes()[:1000])
    elif damage == "an empty image":
        png.write_bytes(b"")
    elif damage == "no image":
        png.unlink()
    else:
        ReferenceStore(tmp_path).save("right", "D1", StoredReference(IMAGE[::-1].copy(), 0.0))
        (tmp_path / "right.png").replace(png)
    with pytest.raises(InputError):
        ReferenceStore(tmp_path).load("left", "D1")
    pipe = pipeline()
    restore_reference(pipe, ReferenceStore(tmp_path), "left", "D1", 0.0)
    assert pipe.stored_reference_state is None
