"""The configuration file as frozen models. Unknown keys are refused; units are in the names.

Each device section names a `driver`. The table of that name inside it belongs to the driver, which checks it with its
`Settings`:

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
from collections.abc import Iterator, Mapping, Sequence
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

from slipguard.config_errors import describe_problems, describe_unknown_key, error_at_key, format_value
from slipguard.control.params import GuardParams
from slipguard.devices import FINGERS
from slipguard.errors import ConfigError
from slipguard.limited_read import read_limited
from slipguard.perception.settings import PerceptionSettings
from slipguard.registry import driver_names, load_driver


class Section(BaseModel):
    """Base of all sections: frozen, no unknown keys, no infinities, no conversion of types."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", allow_inf_nan=False, strict=True, use_attribute_docstrings=True
    )


ConfigPath = Annotated[Path, Strict(False)]
"""A string in the file, because TOML has no paths."""


def _require_int(given: Any) -> Any:
    """Refuse false, which `Literal` alone accepts as 0."""
    if type(given) is not int:
        raise ValueError("must be a whole number")
    return given


class DeviceSection(Section):
    """A device: its driver, and the settings that the driver has checked."""

    driver: str
    """Name of an installed driver; the table of that name has its settings."""
    settings: BaseModel


class FingerSection(DeviceSection):
    """One fingertip camera and how it is mounted."""

    mounting_deg: Annotated[Literal[0, 90, 180, 270], BeforeValidator(_require_int)] = 0
    """Mounting angle of the sensor, counter-clockwise; 0: fingertip at the bottom of the image."""
    px_per_mm: Annotated[float, Field(ge=5.0, le=60.0)] = 18.5
    """Scale of the 240 x 320 image; 18.15 to 18.63 were measured on four DIGITs."""


class GripperSection(DeviceSection):
    """The gripper."""


class ArmSection(DeviceSection):
    """The arm. driver "none": there is none, or slipguard is not connected to it."""

    @property
    def present(self) -> bool:
        """Whether there is an arm."""
        return self.driver != "none"


class LoopSection(Section):
    """The control loop and its workers."""

    period_ms: Annotated[float, Field(ge=2.0, le=100.0)] = 10.0
    """Period of the control loop; it also runs on every new estimate."""
    poll_ms: Annotated[float, Field(ge=5.0, le=500.0)] = 25.0
    """Period at which the state of gripper and arm is read."""
    retry_s: Annotated[float, Field(ge=0.05, le=60.0)] = 0.5
    """Pause before a missing sensor is tried again, doubled once; gripper and arm: at most half of it."""


class ApiSection(Section):
    """The local API."""

    socket: ConfigPath | None = None
    """Unix socket. Default: `slipguard.sock` in the runtime or state directory."""
    listen: str = "127.0.0.1:8470"
    """Address and port of the page and the API over TCP; empty for none. Commands over TCP need the token."""

    @property
    def address(self) -> tuple[str, int] | None:
        """Numeric host, and port; None without TCP."""
        return _address(self.listen)

    @field_validator("listen")
    @classmethod
    def _check_listen(cls, listen: str) -> str:
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
        raise ValueError('must be a numeric address and a port, such as "127.0.0.1:8470", or "" for none') from None
    if not (port.isascii() and port.isdigit() and 0 < int(port) < 65536):
        raise ValueError("the port after the last colon must be 1 to 65535")
    return host, int(port)


class StateSection(Section):
    """Where the state for a restart is stored."""

    directory: ConfigPath | None = None
    """Default: $STATE_DIRECTORY under systemd, else ~/.local/state/slipguard."""


class RecordingSection(Section):
    """Recordings (MCAP): a ring of the last minutes, and the files kept around every slip and fault."""

    enabled: bool = True
    """Whether to record."""
    directory: ConfigPath | None = None
    """Default: `recordings` in the state directory."""
    image: Literal["jpeg", "png", "none"] = "jpeg"
    """png replays to identical rotations, but needs ten times the time and space; none records estimates only."""
    jpeg_quality: Annotated[int, Field(ge=50, le=100)] = 90
    """Quality of JPEG images."""
    ring_s: Annotated[float, Field(ge=20.0, le=86_400.0)] = 600.0
    """Length of the ring."""
    ring_max_mb: Annotated[int, Field(ge=10, le=1_000_000)] = 1000
    """The ring is shorter than `ring_s` if it would need more space than this."""
    keep_before_s: Annotated[float, Field(ge=0.0, le=600.0)] = 20.0
    """Time before an event that is kept."""
    keep_after_s: Annotated[float, Field(ge=0.0, le=600.0)] = 20.0
    """Time after an event that is kept."""
    kept_max_mb: Annotated[int, Field(ge=10, le=1_000_000)] = 4000
    """Beyond this the oldest kept recordings are deleted."""

    @model_validator(mode="after")
    def _ring_long_enough(self) -> RecordingSection:
        if self.keep_before_s > self.ring_s:
            raise error_at_key("keep_before_s", self.keep_before_s, f"must be at most ring_s ({self.ring_s:g})")
        return self


class LogSection(Section):
    """The daemon's log."""

    level: Literal["debug", "info", "warning", "error"] = "info"
    """Messages below this level are left out."""


CONFIG_MAX_BYTES = 2**20
EMPTY = '""'
DEPTH_MAX = 8
"""Tables in tables; a driver's settings are at most 3 deep."""
PERIODS_PER_TIMEOUT = 2
"""A timeout must be longer than one period, by one that is late."""


class Config(Section):
    """The whole config.toml."""

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

    @property
    def warning(self) -> str | None:
        """A valid setting that is probably forgotten: what it causes, and what to do. None if there is none."""
        sensors = [name for name in FINGERS if getattr(self, name).driver == "digit"]
        if not sensors or getattr(self.gripper.settings, "fingertip_mm", None) != 0.0:
            return None
        key, where = f"gripper.{self.gripper.driver}.fingertip_mm", ", ".join(sensors)
        return (
            f"{key} = 0 with a DIGIT on the jaws ({where}): gels that press on each other look like a held object. "
            "Measure the value with `slipguard ctl fingertips`, and enter it"
        )

    @model_validator(mode="after")
    def _timeouts_exceed_periods(self) -> Config:
        """Refuse a timeout that would report a fault although each period is kept."""
        tuning, loop = self.guard.tuning, self.loop
        watched = [
            ("guard.tuning.cycle_timeout_s", tuning.cycle_timeout_s, "loop.period_ms", loop.period_ms),
            ("guard.tuning.gripper_timeout_s", tuning.gripper_timeout_s, "loop.poll_ms", loop.poll_ms),
            ("guard.tuning.arm_timeout_s", tuning.arm_timeout_s, "loop.poll_ms", loop.poll_ms),
        ]
        for device, key, limit_s in (
            (self.gripper, "gripper", tuning.gripper_timeout_s),
            (self.arm, "arm", tuning.arm_timeout_s),
        ):
            response_ms = getattr(device.settings, "timeout_ms", None)
            if response_ms is not None:  # one lost response is no fault
                response = f"{key}.{device.driver}.timeout_ms", response_ms
                watched.append((f"guard.tuning.{key}_timeout_s", limit_s, *response))
        for name in FINGERS:
            section: FingerSection = getattr(self, name)
            fps, stall_ms = getattr(section.settings, "fps", None), getattr(section.settings, "stall_ms", None)
            if fps:
                period = (f"the period of {name}.{section.driver}.fps = {fps:g}", 1e3 / fps)
                watched.append(("guard.tuning.frames_timeout_s", tuning.frames_timeout_s, *period))
                if stall_ms is not None:
                    watched.append((f"{name}.{section.driver}.stall_ms", stall_ms, *period))
        for key, timeout, period_name, period_ms in watched:
            least = PERIODS_PER_TIMEOUT * period_ms / (1.0 if key.endswith("_ms") else 1e3)
            if timeout < least:
                allowed = f"at least {least:.3g}: {PERIODS_PER_TIMEOUT} times {period_name} ({period_ms:.4g} ms)"
                raise error_at_key(key, timeout, f"{allowed}; a shorter timeout reports a fault at once")
        if tuning.tighten_effect_timeout_s <= tuning.tighten_delay_s:
            longer = f"must be longer than guard.tuning.tighten_delay_s ({tuning.tighten_delay_s:g})"
            raise error_at_key("guard.tuning.tighten_effect_timeout_s", tuning.tighten_effect_timeout_s, longer)
        return self


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
DEFAULT_DRIVER = {"left": "digit", "right": "digit", "gripper": "robotiq", "arm": "ur5"}


def read_config(path: Path, *, sim: bool = False) -> Config:
    """Return the checked configuration of a file. sim: with the simulated drivers for all four devices.

    Raises ConfigError: one line with the file, the key, the value and what is allowed.
    """
    try:
        raw = tomllib.loads(read_limited(path, CONFIG_MAX_BYTES).decode("utf-8-sig"))
    except FileNotFoundError as error:
        raise ConfigError(f"{path}: no such file; copy the commented config.toml of the project") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}: cannot be read: {error}") from error
    except (ValueError, RecursionError) as error:  # also for an integer of thousands of digits
        raise ConfigError(f"{path}: not valid TOML: {error}") from error
    return parse_config(raw, where=str(path), sim=sim)


def parse_config(raw: Mapping[str, Any], *, where: str, sim: bool = False) -> Config:
    """Return the checked configuration from the content of a file. where: names the file in errors.

    Raises ConfigError with every mistake that is found.
    """
    if not isinstance(raw, Mapping):  # the last configuration, damaged
        raise ConfigError(f"{where}: must be a table")
    problems = list(_value_problems(raw))
    raise_problems(where, problems)
    problems = [
        f"{key or EMPTY}: {describe_unknown_key(key, list(Config.model_fields))}"
        for key in raw
        if key not in Config.model_fields
    ]
    values = {key: value for key, value in raw.items() if key in Config.model_fields}
    for name in GROUP_OF:
        values[name], mistakes = _with_driver(values.get(name, {}), name, sim)
        problems += mistakes
    problems += _only_one_problems(values)
    config = None
    try:
        config = Config.model_validate(values)
    except ValidationError as error:
        problems += describe_problems(error, Config)
    raise_problems(where, problems)
    assert config is not None
    return config


def raise_problems(where: str, problems: Sequence[str]) -> None:
    """Raise ConfigError with all mistakes of a file, one in a line; do nothing if there is none."""
    if len(problems) == 1:
        raise ConfigError(f"{where}: {problems[0]}")
    if problems:
        raise ConfigError("\n  ".join([f"{where}: {len(problems)} mistakes:", *problems]))


def _value_problems(raw: Mapping[str, Any]) -> Iterator[str]:
    """Yield what TOML can spell, but neither a model nor the operating system can take."""
    waiting: list[tuple[str, Any, int]] = [(key, value, 1) for key, value in raw.items()]
    while waiting:
        key, value, depth = waiting.pop()
        if "\0" in key or (isinstance(value, str) and "\0" in value):
            yield f"{key!r}: contains a NUL character; write it without"
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            yield f"{key!r}: an integer must be from -2^63 to 2^63 - 1"
        elif isinstance(value, Mapping | list) and depth >= DEPTH_MAX:
            yield f"{key!r}: more than {DEPTH_MAX} tables or arrays inside each other"
            continue
        inner = value.items() if isinstance(value, Mapping) else enumerate(value) if isinstance(value, list) else ()
        waiting += [(f"{key}.{name}", one, depth + 1) for name, one in inner]


def _only_one_problems(devices: Mapping[str, Any]) -> Iterator[str]:
    """Yield values that two devices share, of keys in `only_one` of their drivers' `Settings`."""
    users: dict[tuple[str, object], str] = {}
    for name in GROUP_OF:
        driver, settings = devices[name]["driver"], devices[name]["settings"]
        for key in getattr(settings, "only_one", ()):
            value, place = getattr(settings, key), f"{name}.{driver}.{key}"
            user = users.setdefault((key, value), place)
            if user != place:
                yield f"{place} = {format_value(value)}: already used by {user}; the values must differ"


def _with_driver(section: Any, name: str, sim: bool) -> tuple[dict[str, Any], list[str]]:
    """Return the section with the driver's checked table under `settings`, and its mistakes; then it is empty."""
    unchecked = {"driver": "", "settings": _Unchecked()}
    if not isinstance(section, Mapping):
        return unchecked, [f"{name} = {format_value(section)}: must be a table, [{name}]"]
    named = section.get("driver", DEFAULT_DRIVER[name])
    if not isinstance(named, str):
        return unchecked, [f'{name}.driver = {format_value(named)}: must be the name of a driver, such as "digit"']
    chosen = "fake" if sim else named
    try:
        driver = load_driver(GROUP_OF[name], chosen)
    except ConfigError as error:
        return unchecked, [f"{name}.driver = {chosen!r}: {error}"]
    known = [key for key in _SECTIONS[name].model_fields if key != "settings"]
    problems = [
        f"{name}.{key}: {_describe_key(key, [*known, named], name, named)}"
        for key in section
        if key not in (named, *known) and not (sim and key == "fake")
    ]
    settings: BaseModel = _Unchecked()
    try:
        # As JSON, in which strict models still accept a string as a path and an array as a tuple.
        settings = driver.Settings.model_validate_json(json.dumps(section.get(chosen, {}), default=str), strict=True)
    except ValidationError as error:
        problems += describe_problems(error, driver.Settings, under=f"{name}.{chosen}")
    rest = {key: value for key, value in section.items() if key in known}
    return rest | {"driver": chosen, "settings": settings}, problems


class _Unchecked(BaseModel):
    """Stands for the settings of a driver that were not valid, while the rest of the file is checked."""


def _describe_key(key: str, known: list[str], name: str, driver: str) -> str:
    """Return what to do about an unknown key of a device: it may be the table of another driver."""
    if key == "settings":
        return f"no such key; the driver's table is [{name}.{driver}]"
    if key in driver_names(GROUP_OF[name]):
        return f"the table of another driver than {driver!r}; delete it, or set {name}.driver = {key!r}"
    return describe_unknown_key(key, known)


def file_content(config: Config) -> dict[str, Any]:
    """Return a configuration with all defaults as `parse_config` reads it; JSON-compatible. Missing values are None."""
    content = config.model_dump(mode="json", serialize_as_any=True)
    for name in GROUP_OF:
        section = content[name]
        section[section["driver"]] = section.pop("settings")
    return content


def sim_config(draw: str = "process", **tables: Mapping[str, Any]) -> Config:
    """Return a configuration with simulated drivers, and with all defaults except in these tables.

    draw: Where the sensors' images come from, as in `[left.fake]`.
    """
    fingers = {name: {"driver": "fake", "fake": {"draw": draw}} for name in FINGERS}
    return parse_config(fingers | tables, where="--sim", sim=True)
