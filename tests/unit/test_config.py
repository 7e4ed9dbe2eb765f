"""An invalid configuration is reported in one line: the key, the value, the allowed values."""

from __future__ import annotations

import functools
import json
import re
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from command_line import slipguard

from slipguard.config import parse_config, read_config
from slipguard.errors import ConfigError
from slipguard.registry import load_driver

SHIPPED = Path(__file__).parents[2] / "config.toml"


@pytest.fixture(autouse=True, scope="module")
def _drivers_looked_up_once() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("slipguard.config.load_driver", functools.cache(load_driver))
        yield


def complaint(raw: dict[str, Any], *, sim: bool = True) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, where="c.toml", sim=sim)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("c.toml: ")
    return text


def test_the_included_file_is_valid_and_complete() -> None:
    made = read_config(SHIPPED)
    assert (made.left.driver, made.gripper.driver, made.arm.driver) == ("digit", "robotiq", "ur5")
    assert SHIPPED.stat().st_size <= 8000
    for section in ("guard", "perception", "loop", "api", "state", "recording", "log"):
        assert getattr(made, section) == type(getattr(made, section))(), f"[{section}] differs from the defaults"


@pytest.mark.parametrize(
    "table",
    [
        *("guard", "guard.tuning", "perception", "loop", "api", "state", "recording", "log", "left", "gripper", "arm"),
        *("left.digit", "gripper.robotiq", "arm.ur5"),
    ],
)
def test_every_key_is_explained_with_its_default(table: str, capfd: pytest.CaptureFixture[str]) -> None:
    lines = slipguard(capfd, "check", "--explain", table).out.splitlines()
    keys = [line for line in lines if line.startswith(f"{table}.")]
    assert keys
    for line in keys:
        assert re.match(r"[\w.]+ (= .*|\(required\)): \S.{8}", line), line


def test_one_key_is_explained(capfd: pytest.CaptureFixture[str]) -> None:
    shown = slipguard(capfd, "check", "--explain", "left.digit.fps").out
    assert shown == "left.digit.fps = 60: Frame rate. [30, 60]\n"
    assert slipguard(capfd, "check", "--explain", "guard.margin").out.endswith("[from 1.05 to 3]\n")
    wrong = slipguard(capfd, "check", "--explain", "guard.marginn")
    assert (wrong.code, "did you mean 'margin'?" in wrong.complaint) == (2, True)


def test_all_mistakes_are_reported_at_once(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    file = tmp_path / "c.toml"
    file.write_text(
        "[left]\ndriver = 'fake'\nmounting_deg = 45\n[left.digit]\nserial = 'D20001'\n"
        "[right]\ndriver = 'digit'\n[right.digit]\nserial = 'D20002'\nfpz = 60\n"
        "[gripper]\ndriver = 'none'\n[arm]\ndriver = 'fake'\n[guard]\nmargin = 9\nmode = 'fly'\n[gard]\n"
    )
    with pytest.raises(ConfigError) as caught:
        read_config(file)
    first, *mistakes = str(caught.value).splitlines()
    assert first == f"{file}: 7 mistakes:"
    for expected in (
        "gard: no such key; did you mean 'guard'?",
        "left.digit: the table of another driver than 'fake'; delete it, or set left.driver = 'digit'",
        "right.digit.fpz: no such key; did you mean 'fps'?",
        "gripper.driver = 'none': no driver 'none'",
        "guard.margin = 9",
        "guard.mode = 'fly'",
    ):
        assert any(line.strip().startswith(expected) for line in mistakes), (expected, mistakes)
    ran = slipguard(capfd, "check", "--config", file)
    assert (ran.code, ran.complaint.count("no such key")) == (2, 2)


def test_a_typo_names_the_nearest_key() -> None:
    assert "guard.first_forse_n: no such key; did you mean 'first_force_n'?" in complaint(
        {"guard": {"first_forse_n": 3}}
    )
    assert "left.mounting: no such key; did you mean 'mounting_deg'?" in complaint({"left": {"mounting": 0}})


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ({"guard": {"first_force_n": "much"}}, "guard.first_force_n = 'much'"),
        ({"guard": {"first_force_n": float("nan")}}, "guard.first_force_n = nan"),
        ({"guard": {"force_max_n": 1e9}}, "guard.force_max_n = 1000000000.0"),
        ({"left": {"mounting_deg": 45}}, "left.mounting_deg = 45"),
        ({"left": 7}, "left = 7: must be a table, [left]"),
        ({"left": {"driver": 5}}, "left.driver = 5"),
        ({"left": {"settings": {}}}, "left.settings: no such key"),
        ({"loop": {"period_ms": 0}}, "loop.period_ms = 0"),
        ({"perception": {"estimator": "magic"}}, "perception.estimator = 'magic'"),
        ({"unknown": 1}, "unknown: no such key"),
        ({"": 1}, '"": no such key'),
        ({"state": {"": 1}}, 'state."": no such key'),
        ({"guard": {"first_force_n": True}}, "guard.first_force_n = true"),
        ({"guard": {"first_force_n": "40"}}, "guard.first_force_n = '40'"),
        ({"guard": {"stop_on_slip": "off"}}, "guard.stop_on_slip = 'off'"),
        ({"guard": {"stop_on_slip": 1}}, "guard.stop_on_slip = 1"),
        ({"guard": {"tuning": {"estimate_timeout_s": True}}}, "guard.tuning.estimate_timeout_s = true:"),
        (
            {"guard": {"tuning": {"slip_rate_deg_s": list(range(999))}}},
            "guard.tuning.slip_rate_deg_s = [0, 1, 2",
        ),
        ({"left": {"mounting_deg": False}}, "left.mounting_deg = false: must be a whole number"),
        ({"left": {"mounting_deg": 0.0}}, "left.mounting_deg = 0: must be a whole number"),
        ({"left": {"fake": {"stall_ms": "250"}}}, "left.fake.stall_ms = '250'"),
        ({"left": {"fake": 5}}, "left.fake = 5"),
        ({"left": {"fak": {}}}, "left.fak: no such key"),
        ({"recording": {"enabled": "yes"}}, "recording.enabled = 'yes'"),
        ({"state": {"directory": 3}}, "state.directory = 3"),
        ({"guard": {"first_force_n": {"a": 1}}}, "guard.first_force_n: input should be a valid number"),
    ],
)
def test_a_wrong_value_is_shown_with_its_key(raw: dict[str, Any], expected: str) -> None:
    text = complaint(raw)
    assert expected in text
    assert len(text) < 250


TUNING = "guard.tuning."
FAKES = {name: {"driver": "fake"} for name in ("left", "right", "gripper", "arm")}


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ({"loop": {"poll_ms": 500}}, TUNING + "gripper_timeout_s = 0.4: at least 1: 2 times loop.poll_ms (500 ms)"),
        (
            {"loop": {"poll_ms": 500}, "guard": {"tuning": {"gripper_timeout_s": 1.0}}},
            TUNING + "arm_timeout_s = 0.4: at least 1",
        ),
        (
            {"loop": {"period_ms": 100}, "guard": {"tuning": {"cycle_timeout_s": 0.05}}},
            TUNING + "cycle_timeout_s = 0.05: at least 0.2: 2 times loop.period_ms",
        ),
        (
            {"left": {"digit": {"serial": "D1", "fps": 30}}, "guard": {"tuning": {"frames_timeout_s": 0.05}}},
            TUNING + "frames_timeout_s = 0.05: at least 0.0667: 2 times the period of left.digit.fps = 30",
        ),
        (
            {"right": {"digit": {"serial": "D1", "fps": 30, "stall_ms": 50}}},
            "right.digit.stall_ms = 50: at least 66.7",
        ),
        (
            {"gripper": {"robotiq": {"port": "/dev/ttyUSB0", "timeout_ms": 1000}}},
            TUNING + "gripper_timeout_s = 0.4: at least 2: 2 times gripper.robotiq.timeout_ms (1000 ms)",
        ),
        (
            {"guard": {"tuning": {"tighten_effect_timeout_s": 0.2, "tighten_delay_s": 0.5}}},
            TUNING + "tighten_effect_timeout_s = 0.2: must be longer than guard.tuning.tighten_delay_s (0.5)",
        ),
    ],
)
def test_a_timeout_shorter_than_the_period_it_watches_is_refused(raw: dict[str, Any], expected: str) -> None:
    assert expected in complaint(FAKES | raw, sim=False)


@pytest.mark.parametrize("content", [b"a = ", b"\xff\xfe", b"[left"])
def test_an_unreadable_file_is_an_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"c\.toml"):
        read_config(path)


@pytest.mark.parametrize(
    ("listen", "address"),
    [
        ("127.0.0.1:8470", ("127.0.0.1", 8470)),
        ("localhost:1", ("127.0.0.1", 1)),
        ("[::1]:65535", ("::1", 65535)),
        ("0.0.0.0:8470", ("0.0.0.0", 8470)),
        ("", None),
    ],
)
def test_valid_listen_addresses(listen: str, address: tuple[str, int] | None) -> None:
    made = parse_config({"api": {"listen": listen}}, where="test", sim=True)
    assert made.api.address == address


@pytest.mark.parametrize(
    "listen", ["8470", ":8470", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:65536", "cell:8470", "1.2.3.4:+5"]
)
def test_invalid_listen_addresses(listen: str) -> None:
    with pytest.raises(ConfigError, match=r"api\.listen = .*(numeric address|port after)"):
        parse_config({"api": {"listen": listen}}, where="test", sim=True)


@pytest.mark.parametrize(
    ("guard", "expected"),
    [
        (
            {"force_max_n": 60, "no_estimate_force_n": 100},
            "no_estimate_force_n = 100: at most force_max_n (60); lower it, too",
        ),
        ({"force_max_n": 30}, "first_force_n = 40: at most force_max_n (30); lower it, too"),
        ({"no_estimate_force_n": 30}, "no_estimate_force_n = 30: at least first_force_n (40)"),
        ({"friction": 0.5}, "mass_kg: missing; it and friction go together: give both, or neither"),
        ({"mass_kg": 0.5}, "friction: missing; it and mass_kg go together: give both, or neither"),
        ({"friction": 0.4, "mass_kg": 2, "lever_mm": 100}, "force_max_n = 130: friction (0.4), mass_kg (2) and"),
        ({"mode": "guard", "on_force_limit": "lower"}, "on_force_limit = 'lower': for mode = \"lift\""),
        ({"force_max_n": 500}, "force_max_n = 500: input should be less than or equal to 235"),
    ],
)
def test_inconsistent_values_name_the_key_to_change(guard: dict[str, Any], expected: str) -> None:
    text = complaint({"guard": guard})
    assert text.startswith(f"c.toml: guard.{expected}")
    assert len(text) < 250
    assert "more after this one" not in text


def test_an_inconsistent_drivers_table_is_not_printed() -> None:
    devices = {name: {"driver": "fake"} for name in ("left", "right", "gripper")}
    text = complaint(devices | {"arm": {"ur5": {"host": "cell", "stop_by": "digital_output"}}}, sim=False)
    assert text == 'c.toml: arm.ur5: stop_by = "digital_output" needs a number: digital_output = 0 to 7'


def test_one_sensor_for_both_fingers_is_refused() -> None:
    devices = {name: {"driver": "fake"} for name in ("gripper", "arm")}
    digits = {name: {"digit": {"serial": "D20479", "fps": fps}} for name, fps in (("left", 30), ("right", 60))}
    text = complaint(devices | digits, sim=False)
    assert text == "c.toml: right.digit.serial = 'D20479': already used by left.digit.serial; the values must differ"
    sockets = {name: {"driver": "socket", "socket": {"path": "/run/a.sock"}} for name in ("left", "right")}
    assert "right.socket.path = " in complaint(devices | sockets, sim=False)


def leaves(table: dict[str, Any], path: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in table.items():
        if isinstance(value, dict):
            yield from leaves(value, (*path, key))
        else:
            yield (*path, key), value


def test_every_key_of_the_included_file_refuses_another_type() -> None:
    """A number in quotes, a truth for a number and a number for a truth, a number for a word, a list of one."""
    for path, value in leaves(tomllib.loads(SHIPPED.read_text())):
        for wrong in ([value], 7 if isinstance(value, str) else str(value), 1 if isinstance(value, bool) else True):
            raw = tomllib.loads(SHIPPED.read_text())
            table = raw
            for name in path[:-1]:
                table = table[name]
            table[path[-1]] = wrong
            assert complaint(raw, sim=False).startswith(f"c.toml: {'.'.join(path)}")


LONG = "x" * 103
LAST = 'level = "info"              # debug | info | warning | error\n'
UNWORKABLE = [
    ("force_max_n = 130", "force_max_n = 15\nno_estimate_force_n = 15", "first_force_n = 40: at most force_max_n (15)"),
    ("first_force_n = 40\n", "first_force_n = 9\n", None),
    (LAST, '[perception]\nmodel = "{here}"', "perception.model = {here}: a folder"),
    (LAST, '[perception]\nmodel = "{here}/no.onnx"', "perception.model = {here}/no.onnx: no such"),
    (LAST, '[state]\ndirectory = "{here}/c.toml"', "state.directory: {here}/c.toml is not a folder"),
    (
        "enabled = true",
        'enabled = true\ndirectory = "{here}/c.toml/x"',
        "recording.directory: {here}/c.toml is not a folder",
    ),
    ("[api]\n", '[api]\nsocket = "{here}"\n', "api.socket = {here}: a folder"),
    (
        '[left]\ndriver = "digit"',
        '[left]\ndriver = "replay"\nreplay = {{path = "{here}"}}',
        "left.digit: the table of another driver than 'replay'; delete it",
    ),
    ("[api]\n", f'[api]\nsocket = "/run/{LONG}"\n', f"api.socket = /run/{LONG}: longer than 107 bytes"),
    ("[api]\n", '[api]\nsocket = "a\\u0000"\n', "'api.socket': contains a NUL"),
    ("force_max_n = 130", f"force_max_n = 1{'0' * 5000}", "not valid TOML: Exceeds the limit (4300 digits)"),
    ("force_max_n = 130", f"force_max_n = 0x{'f' * 5000}", "'guard.force_max_n': an integer must be from -2^63"),
    ("force_max_n = 130", f"force_max_n = {'[' * 9}{']' * 9}", ": more than 8 tables or arrays inside each other"),
    ("force_max_n = 130", f"force_max_n = {'[' * 5000}", "not valid TOML: "),
]


@pytest.mark.parametrize(("before", "after", "expected"), UNWORKABLE)
def test_check_fails_if_the_daemon_could_not_work(
    before: str, after: str, expected: str | None, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    text = SHIPPED.read_text()
    assert text.count(before) == 1
    path = tmp_path / "c.toml"
    path.write_text(text.replace(before, after.format(here=tmp_path)))
    for words in ([], ["--json"]):
        ran = slipguard(capfd, "check", "--config", path, *words)
        if expected is None:
            assert ran.code == 0
        else:
            assert ran.code == 2
            assert ran.out == (f"{json.dumps({'error': ran.complaint})}\n" if words else "")
            assert expected.format(here=tmp_path) in ran.err
            assert ran.err.count("\n") == 1


def test_check_knows_the_grippers_limits_and_the_frames_of_a_replay(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "c.toml"
    text = SHIPPED.read_text().replace("force_max_n = 130", "force_max_n = 15")
    path.write_text(text.replace("first_force_n = 40", "first_force_n = 15"))
    assert (
        "guard.force_max_n = 15: the minimum force of this gripper is 20 N" in slipguard(capfd, "check", "-c", path).err
    )
    path.write_text(
        f'[left]\ndriver = "replay"\nreplay.path = "{tmp_path}"\n'
        + "".join(f'[{name}]\ndriver = "fake"\n' for name in ("right", "gripper", "arm"))
    )
    ran = slipguard(capfd, "check", "-c", path)
    assert ran.code == 2
    assert "has no .png files" in ran.err


def test_a_fingertip_thickness_that_was_forgotten_is_reported(
    capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path, text = tmp_path / "c.toml", SHIPPED.read_text()
    assert text.count("fingertip_mm = 0 ") == 1
    for content, warns in ((text, True), (text.replace("fingertip_mm = 0 ", "fingertip_mm = 18.5 "), False)):
        path.write_text(content)
        ran = slipguard(capfd, "check", "-c", path)
        assert ran.code == 0, "a warning only"
        assert ("fingertip_mm = 0 with a DIGIT on the jaws (left, right)" in " ".join(ran.out.split())) is warns
        assert ("slipguard ctl fingertips" in ran.out) is warns
    assert read_config(path, sim=True).warning is None
