"""The one configuration file: frozen models, unknown keys refused, ranges and units in the names.

Each device section names a `driver`; the table of that name inside it belongs to the driver and is checked by
the driver's own `Settings`:

    [left]
    driver = "digit"
    mounting_deg = 0
    [left.digit]
    serial = "D20479"
"""

from __future__ import annotations

import ipaddress
import json
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    Strict,
    ValidationError,
    field_validator,
    model_validator,
)

from slipguard.config_errors import at_key, first_complaint, no_such_key, shown
from slipguard.control.params import GuardParams
from slipguard.errors import ConfigError
from slipguard.perception.settings import PerceptionSettings
from slipguard.registry import load_driver


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, no infinities; true is no number and "40" neither."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


SomePath = Annotated[Path, Strict(False)]
"""A string in the file: TOML has no paths."""


def _whole(given: Any) -> Any:
    """`Literal` alone takes false for 0."""
    if type(given) is not int:
        raise ValueError("a whole number is needed")
    return given


class DeviceSection(Section):
    """A device: which driver, and the driver's own settings, already checked by the driver."""

    driver: str
    settings: BaseModel


class FingerSection(DeviceSection):
    """One fingertip camera and how it is mounted."""

    mounting_deg: Annotated[Literal[0, 90, 180, 270], BeforeValidator(_whole)] = 0
    px_per_mm: Annotated[float, Field(ge=5.0, le=60.0)] = 18.5


class GripperSection(DeviceSection):
    """The gripper."""


class ArmSection(DeviceSection):
    """The arm."""


class LoopSection(Section):
    """The control loop and its workers."""

    period_ms: Annotated[float, Field(ge=2.0, le=100.0)] = 10.0
    poll_ms: Annotated[float, Field(ge=5.0, le=500.0)] = 25.0
    """How often gripper and arm are asked for their state."""
    retry_s: Annotated[float, Field(ge=0.05, le=60.0)] = 0.5
    """Pause before a missing sensor is tried again, doubling up to ten times; gripper and arm: half of it at most."""


class ApiSection(Section):
    """The local API."""

    socket: SomePath | None = None
    """Unix socket; None: `slipguard.sock` in the runtime or state directory."""
    listen: str = "127.0.0.1:8470"
    """Address and port of page and API over TCP; empty: none. Commands need the token there."""

    @property
    def address(self) -> tuple[str, int] | None:
        """Host, as a number, and port; None where TCP is not listened at."""
        return _address(self.listen)

    @field_validator("listen")
    @classmethod
    def _listen_at(cls, listen: str) -> str:
        _address(listen)
        return listen


def _address(listen: str) -> tuple[str, int] | None:
    if not listen:
        return None
    host, _, port = listen.rpartition(":")
    host = "127.0.0.1" if host == "localhost" else host.removeprefix("[").removesuffix("]")
    try:
        ipaddress.ip_address(host)
    except ValueError:
        raise ValueError('an address by number and a port are needed, such as "127.0.0.1:8470", or ""') from None
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise ValueError("the port after the last colon must be 1 to 65535")
    return host, int(port)


class StateSection(Section):
    """What survives a restart."""

    directory: SomePath | None = None
    """None: $STATE_DIRECTORY under systemd, else ~/.local/state/slipguard."""


class RecordingSection(Section):
    """The ring of recordings (MCAP): the last minutes, and what is kept around every slip and fault."""

    enabled: bool = True
    directory: SomePath | None = None
    """None: `recordings` in the state directory."""
    image: Literal["jpeg", "png", "none"] = "jpeg"
    """png replays to the very same turns, and costs ten times the time and space; none keeps estimates only."""
    jpeg_quality: Annotated[int, Field(ge=50, le=100)] = 90
    ring_s: Annotated[float, Field(ge=20.0, le=86_400.0)] = 600.0
    ring_max_mb: Annotated[int, Field(ge=10, le=1_000_000)] = 1000
    """The ring is shorter where its time does not fit into this."""
    keep_before_s: Annotated[float, Field(ge=0.0, le=600.0)] = 20.0
    keep_after_s: Annotated[float, Field(ge=0.0, le=600.0)] = 20.0
    kept_max_mb: Annotated[int, Field(ge=10, le=1_000_000)] = 4000
    """Beyond this the oldest kept recordings are deleted."""

    @model_validator(mode="after")
    def _ring_long_enough(self) -> RecordingSection:
        if self.keep_before_s > self.ring_s:
            raise at_key("keep_before_s", self.keep_before_s, f"at most ring_s ({self.ring_s:g}): older is not there")
        return self


class LogSection(Section):
    """The daemon's log."""

    level: Literal["debug", "info", "warning", "error"] = "info"


class Config(Section):
    """All of config.toml."""

    left: FingerSection
    right: FingerSection
    gripper: GripperSection
    arm: ArmSection
    guard: GuardParams = GuardParams()
    perception: PerceptionSettings = PerceptionSettings()
    loop: LoopSection = LoopSection()
    api: ApiSection = ApiSection()
    state: StateSection = StateSection()
    recording: RecordingSection = RecordingSection()
    log: LogSection = LogSection()


GROUP_OF = {
    "left": "slipguard.tactile",
    "right": "slipguard.tactile",
    "gripper": "slipguard.gripper",
    "arm": "slipguard.arm",
}
_SECTIONS: dict[str, type[DeviceSection]] = {
    "left": FingerSection,
    "right": FingerSection,
    "gripper": GripperSection,
    "arm": ArmSection,
}
USUAL_DRIVER = {"left": "digit", "right": "digit", "gripper": "robotiq", "arm": "ur5"}


def read_config(path: Path, *, sim: bool = False) -> Config:
    """Read and check a file; `sim` puts the fakes in place of all four devices.

    Raises ConfigError: one line with the file, the key, the value and what is allowed.
    """
    try:
        raw = tomllib.loads(path.read_bytes().decode("utf-8-sig"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; config.toml in the project is a commented start") from error
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except (tomllib.TOMLDecodeError, RecursionError) as error:
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    return parse_config(raw, where=str(path), sim=sim)


def parse_config(raw: Mapping[str, Any], *, where: str, sim: bool = False) -> Config:
    """Check what a file holds; `where` names it in the complaint."""
    values = dict(raw)
    for name in GROUP_OF:
        values[name] = _with_driver(values.get(name, {}), name, where, sim)
    _nothing_used_twice(values, where)
    try:
        return Config.model_validate(values)
    except ValidationError as error:
        raise ConfigError(f"{where}: {first_complaint(error, Config)}") from None


def _nothing_used_twice(devices: Mapping[str, Any], where: str) -> None:
    """No two devices are the same thing on this machine: their drivers' `Settings` name the keys in `only_one`."""
    users: dict[tuple[str, object], str] = {}
    for name in GROUP_OF:
        driver, settings = devices[name]["driver"], devices[name]["settings"]
        for key in getattr(settings, "only_one", ()):
            value = getattr(settings, key)
            user = users.setdefault((key, value), f"{name}.{driver}.{key}")
            if user != f"{name}.{driver}.{key}":
                raise ConfigError(f"{where}: {name}.{driver}.{key} = {shown(value)}: {user} has it; only one can")


def _with_driver(section: Any, name: str, where: str, sim: bool) -> dict[str, Any]:
    """Let the driver check its own table, and put the result under `settings`."""
    if not isinstance(section, Mapping):
        raise ConfigError(f"{where}: {name} = {shown(section)}: a table is needed, [{name}]")
    named = section.get("driver", USUAL_DRIVER[name])
    if not isinstance(named, str):
        raise ConfigError(f'{where}: {name}.driver = {shown(named)}: the name of a driver is needed, such as "digit"')
    if "settings" in section:
        raise ConfigError(f"{where}: {name}.settings: no such key; the driver's table is [{name}.{named}]")
    chosen = "fake" if sim else named
    try:
        driver = load_driver(GROUP_OF[name], chosen)
    except ConfigError as error:
        raise ConfigError(f"{where}: {name}.driver = {chosen!r}: {error}") from None
    known = [key for key in _SECTIONS[name].model_fields if key != "settings"]
    for key in section:
        if key not in (named, *known) and not (sim and key == "fake"):
            raise ConfigError(f"{where}: {name}.{key}: {no_such_key(key, [*known, named])}")
    try:
        # As JSON: strict, a string is still a path there, and an array a tuple.
        settings = driver.Settings.model_validate_json(json.dumps(section.get(chosen, {}), default=str), strict=True)
    except ValidationError as error:
        told = first_complaint(error, driver.Settings, under=f"{name}.{chosen}")
        raise ConfigError(f"{where}: {told}") from None
    rest = {key: value for key, value in section.items() if key not in (named, chosen)}
    return rest | {"driver": chosen, "settings": settings}


def sim_config() -> Config:
    """What `slipguard run --sim` runs with where there is no file: the fakes and every default."""
    return parse_config({}, where="--sim", sim=True)
