"""The fingers' references on the disk, for whoever starts next: what turns are counted from survives the daemon.

    <state>/references/left.png     the frame it was taken from, 240 x 320 BGR, without loss
    <state>/references/left.json    serial, turns, when, sha256 of the picture

Each is replaced whole, the .json last: a picture that is not the one it names does not count.
"""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from slipguard.atomic_file import write_whole
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import InputError
from slipguard.perception.stored_reference import StoredReference

REFERENCES = "references"
"""Where it is, in the state directory."""
GOOD_FOR = timedelta(hours=1)
"""A reference last held longer ago than this is somebody else's by now."""


Rotation = Annotated[float, Field(ge=-1e6, le=1e6)]


class _Facts(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    format: Literal[1] = 1
    serial: str
    saved_at: datetime
    rotation_deg: Rotation
    earlier_rotation_deg: Rotation
    sha256: str


class ReferenceStore:
    """One reference a finger, in a folder that is made when first written to. Writing raises OSError."""

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._sha256: dict[str, str] = {}

    def save(self, finger: str, serial: str, known: StoredReference) -> None:
        """A new reference. Where that fails, the shelf knows of none of that finger any more."""
        self._sha256.pop(finger, None)
        _, png = cv2.imencode(".png", known.image)
        picture = png.tobytes()
        write_whole(self._folder / f"{finger}.png", picture)
        self._sha256[finger] = hashlib.sha256(picture).hexdigest()
        self.rotation(finger, serial, known)

    def rotation(self, finger: str, serial: str, known: StoredReference) -> None:
        """How far the object has turned, of the reference saved or loaded last; without one it is saved."""
        if finger not in self._sha256:
            self.save(finger, serial, known)
            return
        facts = _Facts(
            serial=serial,
            saved_at=datetime.now(UTC),
            rotation_deg=known.rotation_deg,
            earlier_rotation_deg=known.earlier_rotation_deg,
            sha256=self._sha256[finger],
        )
        write_whole(self._folder / f"{finger}.json", facts.model_dump_json(indent=2).encode())

    def load(self, finger: str, serial: str, now: datetime | None = None) -> StoredReference | None:
        """The reference of a finger with that sensor; None where there is none, or one too old.

        Raises InputError where it is damaged.
        """
        path = self._folder / f"{finger}.json"
        if not path.exists():
            return None
        try:
            facts = _Facts.model_validate_json(path.read_bytes())
            picture = path.with_suffix(".png").read_bytes()
        except (OSError, ValidationError) as error:
            raise InputError(f"{path}: cannot be read; a new reference will be taken") from error
        if facts.serial != serial or (now or datetime.now(UTC)) - facts.saved_at > GOOD_FOR:
            return None
        image = cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR)
        whole = hashlib.sha256(picture).hexdigest() == facts.sha256
        if not whole or image is None or image.shape != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3):
            raise InputError(f"{path.with_suffix('.png')}: is not the picture that was stored; a new one will be taken")
        pixels = np.asarray(image, np.uint8)
        pixels.setflags(write=False)
        self._sha256[finger] = facts.sha256
        return StoredReference(pixels, facts.rotation_deg, facts.earlier_rotation_deg)

    def forget(self) -> None:
        """Nothing is held any more."""
        self._sha256.clear()
        for path in self._folder.glob("*.json"):
            path.unlink(missing_ok=True)
