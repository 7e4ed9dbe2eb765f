"""The state directory: each sensor's background images, and the last grasp with its fault.

    <state>/sensors/<serial>/no_contact-0003.png    background image, 240 x 320 BGR; older ones are kept
    <state>/sensors/<serial>/no_contact-0003.json   noise, light, frames, time, sha256 of the image
    <state>/last_grasp.json                         and last_grasp.unreadable-<time>.json, which could not be used

Every file is written atomically, the .json last: an image without it is not used.
"""

from __future__ import annotations

import hashlib
import os
import re
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Literal, TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray
from pydantic import AwareDatetime, BaseModel, ConfigDict, Field, ValidationError

from slipguard.atomic_file import write_atomically
from slipguard.config_errors import describe_validation_error
from slipguard.control.reports import Fault
from slipguard.daemon.store.background_images import BackgroundImage, BackgroundVersion
from slipguard.daemon.store.dated_file import DatedFile, save_time
from slipguard.devices import FRAME_HEIGHT_PX, FRAME_WIDTH_PX
from slipguard.errors import ConfigError, InputError
from slipguard.limited_read import read_limited

SOCKET_NAME = "slipguard.sock"
_SERIAL = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")
_IMAGE = re.compile(r"no_contact-(\d{4,9})\.json")
FILE_MAX_BYTES = 2**20
"""A state file has some hundred bytes, an image at most 240 kB."""
Level = Annotated[float, Field(ge=0.0, le=255.0)]


class _StateFile(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)


class _BackgroundFacts(_StateFile):
    format: Literal[1] = 1
    serial: str
    created_at: AwareDatetime
    noise_bgr: tuple[Level, Level, Level]
    frames: Annotated[int, Field(ge=1)]
    sha256: str
    level_bgr: tuple[Level, Level, Level] | None = None
    new_gel: bool = False
    copy_of: int | None = None


class LastGrasp(DatedFile):
    """How an object was held: force per finger, width of the jaws.

    force_n: last commanded; 0 if nothing was held. applied: the gripper had confirmed that force. person_near: the arm
    was in a protective or emergency stop, or had been in one since the fault, so the force was not to be increased.
    fault: latched at that time.
    may_hold: something may have been held, with unknown force and width.
    lift_start_mm: tool position where the lift began, in the arm's own frame. force_limit_n: of this grasp alone.
    release_requested, closing_interrupted: the object was not to be guarded during the fault (see `GraspState`).
    """

    format: Literal[5] = 5
    force_n: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    width_mm: Annotated[float, Field(ge=0.0, le=1000.0)] = 0.0
    applied: bool = True
    may_hold: bool = False
    person_near: bool = False
    lift_start_mm: tuple[float, float, float] | None = None
    force_limit_n: Annotated[float, Field(gt=0.0, le=1000.0)] | None = None
    fault: Fault | None = None
    release_requested: bool = False
    closing_interrupted: bool = False


_S = TypeVar("_S", bound=BaseModel)
KEPT = 20
"""Background images of one sensor. The oldest beyond that are deleted, except the first one of the present gel."""


def default_state_path(environ: Mapping[str, str] = os.environ) -> Path:
    """Return $STATE_DIRECTORY under systemd, else $XDG_STATE_HOME/slipguard, else ~/.local/state/slipguard."""
    given = environ.get("STATE_DIRECTORY", "").split(":")[0]
    if given:
        return Path(given)
    home = environ.get("XDG_STATE_HOME") or str(Path(environ.get("HOME") or Path.home()) / ".local" / "state")
    return Path(home) / "slipguard"


def decode_stored_frame(png: bytes, sha256: str) -> NDArray[np.uint8] | None:
    """Return the pixels of a stored frame, (320, 240, 3) uint8 BGR, read-only; None if it is not what was stored."""
    if hashlib.sha256(png).hexdigest() != sha256:
        return None
    try:
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error:  # an empty file, or more pixels than OpenCV's limit
        return None
    if image is None or image.shape != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3):
        return None
    pixels = np.asarray(image, np.uint8)
    pixels.setflags(write=False)
    return pixels


class StateDir:
    """The state directory; made by the first write.

    path: None for the default. Reading raises InputError for a damaged file, writing ConfigError if it fails.
    """

    def __init__(self, path: Path | None = None, environ: Mapping[str, str] = os.environ) -> None:
        self.path = path if path is not None else default_state_path(environ)
        runtime = environ.get("RUNTIME_DIRECTORY", "").split(":")[0]
        self.runtime_path = Path(runtime) if runtime else self.path
        """Folder of the socket: $RUNTIME_DIRECTORY under systemd, else the state directory."""

    # --- background images ---

    def save_background(self, serial: str, taken: BackgroundImage, *, new_gel: bool = False) -> None:
        """Store a new background image of a sensor; older ones stay. new_gel: the gel has been replaced."""
        self._save(serial, taken, datetime.now(UTC), new_gel, None)

    def restore_background(self, serial: str, number: int) -> None:
        """Copy an older image of a sensor as its newest. Raises InputError if there is none."""
        versions = {version.number: version for version in self.background_versions(serial)}
        if number not in versions:
            known = ", ".join(str(one) for one in versions) or "none"
            raise InputError(f"{serial}: background image {number} not found; stored numbers: {known}")
        self._save(serial, self._load(serial, number), versions[number].created_at, False, number)

    def _save(
        self, serial: str, taken: BackgroundImage, created_at: datetime, new_gel: bool, copy_of: int | None
    ) -> None:
        folder = self._sensor(serial)
        number = max(self._numbers(folder), default=0) + 1
        encoded, png = cv2.imencode(".png", taken.image)
        if not encoded or taken.image.shape != (FRAME_HEIGHT_PX, FRAME_WIDTH_PX, 3):
            raise InputError(f"{serial}: the background image has shape {taken.image.shape}; it must be (320, 240, 3)")
        png_bytes = png.tobytes()
        blue, green, red = (float(level) for level in taken.image.mean(axis=(0, 1)))
        facts = _BackgroundFacts(
            serial=serial,
            created_at=created_at,
            noise_bgr=taken.noise_bgr,
            frames=taken.frames,
            sha256=hashlib.sha256(png_bytes).hexdigest(),
            level_bgr=(blue, green, red),
            new_gel=new_gel,
            copy_of=copy_of,
        )
        _write(folder / f"no_contact-{number:04d}.png", png_bytes)
        _write(folder / f"no_contact-{number:04d}.json", facts.model_dump_json(indent=2).encode())
        self._delete_oldest(serial)

    def _delete_oldest(self, serial: str) -> None:
        numbers = sorted(self._numbers(self._sensor(serial)))
        first = self._gel_began(self.background_versions(serial))
        for number in numbers[:-KEPT]:
            if number != first:
                path = self._sensor(serial) / f"no_contact-{number:04d}.json"
                path.unlink(missing_ok=True)
                path.with_suffix(".png").unlink(missing_ok=True)

    def background_versions(self, serial: str) -> list[BackgroundVersion]:
        """Return the stored background images of a sensor, oldest first; damaged ones are left out."""
        folder = self._sensor(serial)
        found = []
        for number in sorted(self._numbers(folder)):
            try:
                facts = _read(folder / f"no_contact-{number:04d}.json", _BackgroundFacts)
            except InputError:
                continue
            properties = (facts.noise_bgr, facts.level_bgr, facts.frames, facts.new_gel, facts.copy_of)
            found.append(BackgroundVersion(number, facts.created_at, *properties))
        return found

    def gel_number(self, serial: str) -> int | None:
        """Return the number of the first image of a sensor's present gel; None if there is none."""
        return self._gel_began(self.background_versions(serial))

    @staticmethod
    def _gel_began(history: list[BackgroundVersion]) -> int | None:
        """Return the number of the present gel's first image."""
        fresh = [version.number for version in history if version.new_gel]
        return max(fresh, default=min((version.number for version in history), default=None))

    def first_of_gel(self, serial: str) -> BackgroundImage | None:
        """Return the first image of a sensor's present gel; None if there is none. Raises InputError if damaged."""
        number = self.gel_number(serial)
        return None if number is None else self._load(serial, number)

    def load_background(self, serial: str, number: int | None = None) -> BackgroundImage | None:
        """Return a background image of a sensor; None if there is none.

        number: None for the newest. Raises InputError if it is damaged.
        """
        numbers = self._numbers(self._sensor(serial))
        if number is None:
            number = max(numbers, default=None)
        return None if number is None or number not in numbers else self._load(serial, number)

    def _load(self, serial: str, number: int) -> BackgroundImage:
        path = self._sensor(serial) / f"no_contact-{number:04d}.json"
        action = f"move {path.with_suffix('')}.* away or run `slipguard calibrate`"
        facts = _read(path, _BackgroundFacts, f"; {action}")
        png_path = path.with_suffix(".png")
        try:
            png = read_limited(png_path, FILE_MAX_BYTES)
        except OSError as error:
            raise InputError(f"{png_path}: cannot be read ({error.strerror}); {action}") from None
        pixels = decode_stored_frame(png, facts.sha256)
        if pixels is None:
            raise InputError(f"{png_path}: not the image of 240 x 320 that was stored (its sha256 differs); {action}")
        return BackgroundImage(pixels, facts.noise_bgr, facts.frames)

    def background_created_at(self, serial: str) -> datetime | None:
        """Return when the newest background image of a sensor was taken; None if there is none."""
        folder = self._sensor(serial)
        number = max(self._numbers(folder), default=None)
        return None if number is None else _read(folder / f"no_contact-{number:04d}.json", _BackgroundFacts).created_at

    def _sensor(self, serial: str) -> Path:
        if not _SERIAL.fullmatch(serial):
            raise InputError(
                f"serial number {serial!r}: only letters, digits, '.', '_' and '-' are allowed, at most 64"
            )
        return self.path / "sensors" / serial

    @staticmethod
    def _numbers(folder: Path) -> list[int]:
        try:
            return [int(match[1]) for name in os.listdir(folder) if (match := _IMAGE.fullmatch(name))]
        except (FileNotFoundError, NotADirectoryError):
            return []
        except OSError as error:
            raise InputError(f"{folder}: cannot be read ({error.strerror}); check its owner and permissions") from None

    # --- the last grasp ---

    def save_last_grasp(self, last: LastGrasp) -> None:
        """Store how the object is held, for a restart."""
        _write(self.path / "last_grasp.json", last.model_dump_json(indent=2).encode())

    def load_last_grasp(self) -> LastGrasp | None:
        """Return how an object was held before a restart; None if nothing was.

        Raises InputError if that is unknown: the file is damaged, cannot be read, or is a link to a missing one. Such a
        file is kept under another name, and what is stored from then on is that something may be held.
        """
        try:
            return _read_if_there(self.path / "last_grasp.json", LastGrasp)
        except InputError as error:
            aside = self._set_aside_last_grasp()
            raise InputError(f"{error}" + ("" if aside is None else f" (kept as {aside.name})")) from None

    def _set_aside_last_grasp(self) -> Path | None:
        """Return the new path; None if the folder cannot be written: then the file stays."""
        path = self.path / "last_grasp.json"
        aside = self.path / f"last_grasp.unreadable-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}.json"
        try:
            try:
                os.link(path, aside, follow_symlinks=False)  # a daemon that is killed now still finds the file
            except OSError:  # a folder, or another user's file
                path.rename(aside)
            self.save_last_grasp(LastGrasp(**save_time(), may_hold=True))
        except (OSError, ConfigError):
            return None
        return aside

    def delete_last_grasp(self) -> None:
        """Delete the last grasp, because nothing is held any more."""
        (self.path / "last_grasp.json").unlink(missing_ok=True)


def _read_if_there(path: Path, kind: type[_S]) -> _S | None:
    """Return a state file; None if there is none. A link to a missing file or folder counts as a damaged file."""
    try:
        path.lstat()
    except FileNotFoundError:
        if not os.path.islink(path.parent) or os.path.exists(path.parent):
            return None
    except OSError:
        pass  # reported by reading it
    return _read(path, kind)


def _read(path: Path, kind: type[_S], action: str = "") -> _S:
    try:
        return kind.model_validate_json(read_limited(path, FILE_MAX_BYTES))
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}){action}") from None
    except ValidationError as error:
        raise InputError(f"{path}: damaged: {describe_validation_error(error, kind)}{action}") from None


def _write(path: Path, content: bytes) -> None:
    try:
        write_atomically(path, content)
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be written ({error.strerror}); set [state] directory to a writable folder"
        ) from error
