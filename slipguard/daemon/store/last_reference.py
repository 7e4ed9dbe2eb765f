"""Each finger's reference frame and last rotation, kept on the disk while something is held, for a restart.

    <state>/references/left.png     the reference frame, 320 x 240
    <state>/references/left.json    serial number, when it was saved, rotation, sha256 of the image

Each file is replaced as a whole, the .json last. An image whose sha256 differs from the .json is not used.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Annotated, Literal

import cv2
import structlog
from pydantic import Field, ValidationError

from slipguard.atomic_file import write_atomically
from slipguard.control.state import AT_STAKE, Phase
from slipguard.daemon.loop.decision import Decision
from slipguard.daemon.loop.finger import Finger, PerceptionPipeline
from slipguard.daemon.store.dated_file import DatedFile, save_time
from slipguard.daemon.store.disk_writer import DiskWriter
from slipguard.daemon.store.state_dir import FILE_MAX_BYTES, decode_stored_frame
from slipguard.errors import InputError
from slipguard.limited_read import read_limited
from slipguard.perception.stored_reference import ResumingPipeline, StoredReference

REFERENCES = "references"
"""Folder in the state directory."""
ROTATION_STEP_DEG = 1.0
"""A smaller change of the rotation is not written, ..."""
REFRESH_S = 300.0
"""... unless the last write is older than this: the age of a reference decides whether it is used."""
Rotation = Annotated[float, Field(ge=-1e6, le=1e6)]
log = structlog.get_logger()


class _ReferenceFacts(DatedFile):
    format: Literal[1] = 1
    serial: str
    rotation_deg: Rotation
    earlier_rotation_deg: Rotation
    sha256: str


class ReferenceStore:
    """One reference per finger, in a folder that is made by the first write. Writing raises OSError."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sha256: dict[str, str] = {}

    def save(self, finger: str, serial: str, known: StoredReference) -> None:
        """Store a new reference. After a failure the finger has no stored reference."""
        self._sha256.pop(finger, None)
        png = cv2.imencode(".png", known.image)[1].tobytes()
        write_atomically(self._folder / f"{finger}.png", png)
        self._sha256[finger] = hashlib.sha256(png).hexdigest()
        self.save_rotation(finger, serial, known)

    def save_rotation(self, finger: str, serial: str, known: StoredReference) -> None:
        """Store the rotation since the reference that was saved or loaded last; if there is none, save it first."""
        if finger not in self._sha256:
            self.save(finger, serial, known)
            return
        facts = _ReferenceFacts(
            serial=serial,
            **save_time(),
            rotation_deg=known.rotation_deg,
            earlier_rotation_deg=known.earlier_rotation_deg,
            sha256=self._sha256[finger],
        )
        write_atomically(self._folder / f"{finger}.json", facts.model_dump_json(indent=2).encode())

    def load(self, finger: str, serial: str, now: datetime | None = None) -> StoredReference | None:
        """Return the reference of a finger with this sensor; None if there is none or it is too old.

        Raises InputError if it is damaged.
        """
        path = self._folder / f"{finger}.json"
        try:
            content = read_limited(path, FILE_MAX_BYTES)
        except FileNotFoundError:
            return None
        except OSError as error:
            raise InputError(f"{path}: cannot be read ({error.strerror}); a new reference will be taken") from error
        try:
            facts = _ReferenceFacts.model_validate_json(content)
            png = read_limited(path.with_suffix(".png"), FILE_MAX_BYTES)
        except (OSError, ValidationError) as error:
            raise InputError(f"{path}: cannot be read; a new reference will be taken") from error
        if facts.serial != serial or facts.outdated(now) is not None:
            return None
        pixels = decode_stored_frame(png, facts.sha256)
        if pixels is None:
            raise InputError(f"{path.with_suffix('.png')}: not the image that was stored; a new one will be taken")
        self._sha256[finger] = facts.sha256
        return StoredReference(pixels, facts.rotation_deg, facts.earlier_rotation_deg)

    def delete_all(self) -> None:
        """Delete the references of all fingers, because nothing is held any more."""
        self._sha256.clear()
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)


def restore_reference(
    pipeline: ResumingPipeline, store: ReferenceStore, finger: str, serial: str, now_s: float
) -> None:
    """Let a new pipeline resume from the finger's stored reference, if there is a good one; log a damaged one."""
    try:
        known = store.load(finger, serial)
        if known is not None:
            pipeline.resume(known, now_s)
    except InputError as error:
        log.error("stored reference not used", reason=str(error))


@dataclass(frozen=True, slots=True)
class _SavedReference:
    """The stored reference of one finger."""

    serial: str
    known: StoredReference
    saved_at_s: float


class ReferenceSaver:
    """Observes decisions and saves the references in a thread, so that the loop never waits for the disk.

    Args:
        store: Where references are stored.
        fingers: Whose references are saved; a pipeline that is no `ResumingPipeline` has none.
        info: Receives what became of a stored reference, and the recovery of the disk.
        warning: Receives failures of the disk.
    """

    def __init__(
        self,
        store: ReferenceStore,
        fingers: Mapping[str, Finger],
        info: Callable[[str], None],
        warning: Callable[[str], None],
    ) -> None:
        self._store, self._fingers, self._info = store, fingers, info
        self._saved: dict[str, _SavedReference] = {}
        self._empty = False
        self._reported: dict[str, PerceptionPipeline] = {}
        self._disk = DiskWriter("last reference", "the references", info, warning)

    def add_decision(self, decision: Decision) -> None:
        """Save what has changed; to be called after every cycle of the loop."""
        for name, finger in self._fingers.items():
            self._report_restored(name, finger)
        gripper = decision.observation.gripper
        if gripper is None or self._disk.busy or (self._disk.failed and not self._disk.due):
            return  # a later cycle will do
        if self._disk.failed:
            self._saved, self._empty = {}, False  # what was written is not known: write all again
        if decision.phase in AT_STAKE or decision.phase is Phase.FAULT:
            new = {
                name: changed
                for name, finger in self._fingers.items()
                if (changed := self._changed(name, finger, decision.now_s))
            }
            if gripper.holding and new:
                self._empty = False
                before, self._saved = self._saved, {**self._saved, **new}
                self._disk.begin(lambda: self._save(new, before))
        elif not gripper.holding and not self._empty:
            self._empty = True
            self._saved = {}
            self._disk.begin(self._store.delete_all)

    def _report_restored(self, name: str, finger: Finger) -> None:
        pipeline = finger.pipeline
        if not isinstance(pipeline, ResumingPipeline) or self._reported.get(name) is pipeline:
            return
        if pipeline.stored_reference_state == "matches":
            self._info(f"{name} finger: continues with the reference from before the restart")
        elif pipeline.stored_reference_state == "differs":
            self._info(
                f"{name} finger: the contact differs from before the restart; continues from "
                f"{pipeline.earlier_rotation_deg:.0f}° with a new reference"
            )
        if pipeline.stored_reference_state in ("matches", "differs"):
            self._reported[name] = pipeline

    def _changed(self, name: str, finger: Finger, now_s: float) -> _SavedReference | None:
        """Return what has to be written of a finger; None if nothing."""
        pipeline, newest = finger.pipeline, finger.newest
        if not isinstance(pipeline, ResumingPipeline) or newest is None or finger.serial is None:
            return None
        image, rotation_deg = pipeline.reference_image, newest.estimate.rotation_deg
        if image is None or rotation_deg is None:
            return None
        earlier_deg = pipeline.earlier_rotation_deg + pipeline.carried_deg
        known = StoredReference(image, rotation_deg - earlier_deg, earlier_deg)
        before = self._saved.get(name)
        if (
            before is not None
            and before.known.image is image
            and abs(known.rotation_deg - before.known.rotation_deg) < ROTATION_STEP_DEG
            and now_s - before.saved_at_s < REFRESH_S
        ):
            return None
        return _SavedReference(finger.serial, known, now_s)

    def _save(self, new: Mapping[str, _SavedReference], before: Mapping[str, _SavedReference]) -> None:
        for name, saved in new.items():
            if name in before and before[name].known.image is saved.known.image:
                self._store.save_rotation(name, saved.serial, saved.known)
            else:
                self._store.save(name, saved.serial, saved.known)
