"""Keeps each finger's reference and last turn on a shelf while something is held, and says what came of an old one."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

import structlog

from slipguard.control.state import AT_STAKE, Phase
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.finger import Finger, PerceptionPipeline
from slipguard.daemon.store.disk_writer import DiskWriter
from slipguard.errors import InputError
from slipguard.perception.stored_reference import ResumingPipeline, StoredReference

ROTATION_DEG = 1.0
"""A turn that has grown by less is not worth a write,"""
AGAIN_S = 300.0
"""... but after this time it is: a reference's age tells it from somebody else's."""
log = structlog.get_logger()


class Shelf(Protocol):
    """Where references are kept, as `ReferenceShelf`; writing may raise OSError, `load` InputError."""

    def save(self, finger: str, serial: str, known: StoredReference) -> None: ...

    def rotation(self, finger: str, serial: str, known: StoredReference) -> None: ...

    def load(self, finger: str, serial: str) -> StoredReference | None: ...

    def forget(self) -> None: ...


def recall(pipeline: ResumingPipeline, shelf: Shelf, finger: str, serial: str, now_s: float) -> None:
    """Let a new pipeline go on with the finger's old reference, if there is a good one; a damaged one is said."""
    try:
        known = shelf.load(finger, serial)
        if known is not None:
            pipeline.recall(known, now_s)
    except InputError as error:
        log.error("last reference", why=str(error))


@dataclass(frozen=True, slots=True)
class _Kept:
    """What the shelf holds of a finger."""

    serial: str
    known: StoredReference
    noted_at_s: float


class ReferenceSaver:
    """Watches decisions and keeps the shelf up to date, in a thread: the loop never waits for the disk.

    fingers: whose pipelines are looked at; one that is no `ResumingPipeline` has nothing to keep. warn: told of a disk
    that fails; say: of all else.
    """

    def __init__(
        self,
        shelf: Shelf,
        fingers: Mapping[str, Finger],
        say: Callable[[str], None],
        warn: Callable[[str], None],
    ) -> None:
        self._shelf, self._fingers, self._say = shelf, fingers, say
        self._kept: dict[str, _Kept] = {}
        self._empty = False
        self._told: dict[str, PerceptionPipeline] = {}
        self._disk = DiskWriter("last reference", "the references", say, warn)

    def decided(self, decision: Decision) -> None:
        """To be called after every turn of the loop."""
        for name, finger in self._fingers.items():
            self._tell(name, finger)
        gripper = decision.observation.gripper
        if gripper is None or self._disk.busy or (self._disk.failed and not self._disk.due):
            return  # not known, or the disk cannot: a later turn will do
        if self._disk.failed:
            self._kept, self._empty = {}, False  # nobody knows what of it is on the shelf: all is written again
        if decision.phase in AT_STAKE or decision.phase is Phase.FAULT:
            new = {
                name: kept
                for name, finger in self._fingers.items()
                if (kept := self._news(name, finger, decision.now_s))
            }
            if gripper.holding and new:
                self._empty = False
                before, self._kept = self._kept, {**self._kept, **new}
                self._disk.begin(lambda: self._save(new, before))
        elif not gripper.holding and not self._empty:
            self._empty = True
            self._kept = {}
            self._disk.begin(self._shelf.forget)

    def _tell(self, name: str, finger: Finger) -> None:
        pipeline = finger.pipeline
        if not isinstance(pipeline, ResumingPipeline) or self._told.get(name) is pipeline:
            return
        if pipeline.stored_reference_state == "matches":
            self._say(f"{name} finger: goes on with the reference of before the restart")
        elif pipeline.stored_reference_state == "differs":
            self._say(
                f"{name} finger: does not see what it saw before the restart: a new reference, counted from "
                f"{pipeline.earlier_rotation_deg:.0f}°"
            )
        if pipeline.stored_reference_state in ("matches", "differs"):
            self._told[name] = pipeline

    def _news(self, name: str, finger: Finger, now_s: float) -> _Kept | None:
        """What is worth writing of a finger."""
        pipeline, newest = finger.pipeline, finger.newest
        if not isinstance(pipeline, ResumingPipeline) or newest is None or finger.serial is None:
            return None
        image, rotation_deg = pipeline.reference_image, newest.estimate.angle_deg
        if image is None or rotation_deg is None:
            return None
        known = StoredReference(image, rotation_deg - pipeline.earlier_rotation_deg, pipeline.earlier_rotation_deg)
        before = self._kept.get(name)
        if (
            before is not None
            and before.known.image is image
            and abs(known.rotation_deg - before.known.rotation_deg) < ROTATION_DEG
            and now_s - before.noted_at_s < AGAIN_S
        ):
            return None
        return _Kept(finger.serial, known, now_s)

    def _save(self, new: Mapping[str, _Kept], before: Mapping[str, _Kept]) -> None:
        for name, kept in new.items():
            if name in before and before[name].known.image is kept.known.image:
                self._shelf.rotation(name, kept.serial, kept.known)
            else:
                self._shelf.save(name, kept.serial, kept.known)
