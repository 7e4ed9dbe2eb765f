"""Wrong usage: one helpful line and exit code 2; with --json the same line as JSON on stdout, else nothing there."""

from __future__ import annotations

import json
import re
import tempfile
from collections.abc import Callable, Coroutine, Iterator
from pathlib import Path
from typing import Any

import pytest
import typer
from command_line import slipguard

from slipguard.cli.app import app
from slipguard.daemon import run as root
from slipguard.errors import ConfigError
from slipguard.perception.segmenter import default_model_path

WRONG = {
    "frobnicate": "no such command 'frobnicate'; see `slipguard --help`",
    "ctl frobnicate": "see `slipguard ctl --help`",
    "ctl guard": "on, off",
    "ctl guard maybe": "'maybe' is not one of 'on', 'off'",
    "ctl grasp --force-n much": "--force-n",
    "ctl grasp --force-n 300": "invalid value for --force-n: 300: input should be less than or equal to 235",
    "ctl lift --speed-mm-s 0": "invalid value for --speed-mm-s: 0: input should be greater than 0",
    "--sim --lifts 0": "at least one lift",
    "--sim --lifts -1": "at least one lift",
    "--sim --lifts many": "--lifts",
    "--sim --seed -1": "--seed",
    "--sim --speed warp": "'warp' is not one of 'realtime', 'fast'",
    "--sim --sedd 1": "--sedd",
    "--sim check": "slipguard run --config FILE --sim",
    "--no-guard": "need --sim",
    "--json": "need --sim",
    "measure": "missing argument 'paths'",
    "measure nowhere": "no such file or folder",
    "measure . --reference last": "'last' is not one of",
    "check --config nowhere.toml": "no such file; copy the commented config.toml of the project",
    "run --config nowhere.toml": "no such file",
    "run --config nowhere.toml --sim": "no such file",
    "run": "config.toml: no such file",
    "calibrate --config nowhere.toml": "no such file",
    "dataset render --count 3": "--out",
    "dataset render --out . --count 0": "count",
    "train --frames 1": "--frames",
    "bench --quick --model nowhere.onnx": "no such file",
    "bench --plant mujoco": "add --grip, or omit them",
    "bench --seed 5": "add --grip, or omit them",
    "bench --cluster tcp://127.0.0.1:1": "add --full, or omit --cluster",
    "bench --grip --seed -1": "invalid value for '--seed'",
    "measure . --plot .": "Name a file that ends with .png, .pdf, .svg",
    "measure . --plot rotation.jpeg2": "Name a file that ends with .png, .pdf, .svg",
    "measure . --plot nowhere/rotation.png": "the folder nowhere does not exist",
    "evaluate rotation . --intrinsics nowhere.json --plot nowhere/rotation.png": "the folder nowhere does not exist",
    "version --verbose": "--verbose",
    "calibrate --back-to 1 --finger middle": "--finger middle: choose left or right",
}


@pytest.fixture(autouse=True)
def _somewhere_empty(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("HOME", str(tmp_path))
    for name in ("STATE_DIRECTORY", "RUNTIME_DIRECTORY"):
        monkeypatch.delenv(name, raising=False)
    with tempfile.TemporaryDirectory(prefix="sg") as short:  # a Unix socket's path has at most 107 bytes
        monkeypatch.setenv("XDG_STATE_HOME", short)
        yield


@pytest.mark.parametrize("line", WRONG)
def test_misuse_is_one_line(line: str, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    ran = slipguard(capfd, *line.split())
    assert WRONG[line] in ran.complaint
    assert ran.code == 2
    assert ran.out == (json.dumps({"error": ran.complaint}) + "\n" if "--json" in line.split() else "")
    assert list(tmp_path.iterdir()) == []


def commands_with_json(command: Any, path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Yield the path of every command that has the option --json."""
    if any("--json" in one.opts for one in command.params):
        yield path
    for name, one in getattr(command, "commands", {}).items():
        yield from commands_with_json(one, (*path, name))


@pytest.mark.parametrize("path", list(commands_with_json(typer.main.get_command(app))), ids=" ".join)
def test_an_error_of_every_command_with_json_is_json(path: tuple[str, ...], capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd, *path, "--json", "--unknown-option")
    assert ran.code == 2
    assert json.loads(ran.out) == {"error": ran.complaint}
    assert "--unknown-option" in ran.complaint


@pytest.mark.parametrize(
    "line", ["ctl lift --socket nowhere.sock", "check --config nowhere.toml", "measure nowhere", "--sim --lifts 0"]
)
def test_an_error_at_work_is_json_too(line: str, capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd, *line.split(), "--json")
    assert ran.code in (1, 2)
    assert json.loads(ran.out) == {"error": ran.complaint}


UR5_KEYS = (
    "host", "speed_max_mm_s", "acceleration_mm_s2", "stop_mm_s2", "watchdog_hz", "registers", "stop_by", "pulse_ms",
)  # fmt: skip
CONFIGS = {
    "typo": ("[guard]\nfirst_forse_n = 3\n", "guard.first_forse_n: no such key; did you mean 'first_force_n'?"),
    "wrong type": ('[guard]\nfirst_force_n = "much"\n', "guard.first_force_n = 'much'"),
    "wrong range": ("[guard]\nfirst_force_n = 1000\n", "guard.first_force_n = 1000"),
    "wrong unit": ("[guard]\nfirst_force_kg = 3\n", "guard.first_force_kg: no such key"),
    "not TOML": ("[guard\n", "not valid TOML"),
    "empty driver": ('[left]\ndriver = ""\n', "left.driver = ''"),
    "missing model": ('[perception]\nmodel = "none.onnx"\n', "none.onnx: no such file"),
    "empty": ("", "missing; it must be given"),
}


@pytest.mark.parametrize("kind", CONFIGS)
@pytest.mark.parametrize("command", ["check", "run"])
def test_a_bad_configuration_names_file_key_and_value(
    command: str, kind: str, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    text, output = CONFIGS[kind]
    serials = '[left.digit]\nserial = "D1"\n[right.digit]\nserial = "D2"\n[gripper.robotiq]\nport = "/dev/null"\n'
    path = tmp_path / "cell.toml"
    path.write_text(text + (serials + '[arm.ur5]\nhost = "127.0.0.1"\n' if text else ""))
    ran = slipguard(capfd, command, "--config", path)
    assert output in ran.complaint
    assert ran.code == 2
    assert [entry.name for entry in tmp_path.iterdir()] == ["cell.toml"]


def test_a_corrupt_model_in_the_configuration(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    model = tmp_path / "half.onnx"
    whole = default_model_path().read_bytes()
    model.write_bytes(whole[: len(whole) // 2])
    shipped = (Path(__file__).parents[3] / "config.toml").read_text()
    path = tmp_path / "cell.toml"
    path.write_text(f'{shipped}[perception]\nmodel = "{model}"\n')
    for command in ("check", "run"):
        ran = slipguard(capfd, command, "--config", path)
        assert "not a readable ONNX model" in ran.complaint
        assert (f"{path}: perception.model = {model}" in ran.complaint) == (command == "check")
        assert ran.code == 2


def test_a_configuration_with_a_byte_order_mark_is_read(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    path.write_text((Path(__file__).parents[3] / "config.toml").read_text(), encoding="utf-8-sig")
    assert slipguard(capfd, "check", "--config", path).code == 0


@pytest.mark.parametrize(
    ("given", "changed", "output"),
    [
        ("D20479", "D 1", "left.digit.serial = 'D 1': must consist of letters and digits"),
        ("192.168.1.10", "a b", "arm.ur5.host = 'a b': must be a host name or an address, without blanks"),
        (
            "192.168.1.10",
            "192.168.1.10 ",
            "arm.ur5.host = '192.168.1.10 ': must be a host name or an address, without blanks",
        ),
        ("/dev/serial", "", "gripper.robotiq.port = ''"),
    ],
)
def test_invalid_device_settings_are_named(
    given: str, changed: str, output: str, capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    path = tmp_path / "cell.toml"
    shipped = (Path(__file__).parents[3] / "config.toml").read_text()
    path.write_text(re.sub(f'"{given}[^"]*"', f'"{changed}"', shipped, count=1))
    assert output in slipguard(capfd, "check", "--config", path).complaint


@pytest.mark.parametrize("words", [("--sim",), ("bench", "--quick")])
def test_out_on_a_file_is_refused_before_anything_runs(
    words: tuple[str, ...], capfd: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    there = tmp_path / "there"
    there.write_text("keep me")
    ran = slipguard(capfd, *words, "--out", there)
    assert "cannot create the folder" in ran.complaint
    assert ran.code == 2
    assert there.read_text() == "keep me"


def test_without_arguments_there_is_help_with_an_example(capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd)
    assert ran.code == 0
    assert "Example:" in ran.out
    assert "--no-guard" in ran.out
    assert ran.err == ""


@pytest.mark.parametrize(
    "command",
    ["state", "grasp", "lift", "stop", "guard on", "release --yes", "clear", "gripper --width-mm 60", "calibrate"],
)
def test_ctl_without_a_daemon_says_how_to_start_one(command: str, capfd: pytest.CaptureFixture[str]) -> None:
    ran = slipguard(capfd, "ctl", *command.split())
    assert "start it with `slipguard run`" in ran.complaint
    assert ran.code == 1


def test_a_disk_error_is_one_line(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    ran = slipguard(capfd, "train", "--frames", "64", "--work", tmp_path / "file")
    assert ran.complaint


def fails_with(error: BaseException) -> Callable[..., Coroutine[None, None, None]]:
    async def run(*words: object, **options: object) -> None:
        raise error

    return run


FAILURES = [
    (ConfigError("api.socket = x: cannot be made"), "api.socket = x: cannot be made", 2),
    (OSError(28, "No space left on device", "/state/x"), "/state/x: No space left on device", 1),
    (RuntimeError("can't start new thread"), "can't start new thread; raise the limit of processes", 1),
    (MemoryError(), "out of memory; raise the memory limit", 1),
]


@pytest.mark.parametrize(("failure", "line", "code"), FAILURES)
def test_a_failure_of_the_daemon_is_one_line(
    failure: Exception, line: str, code: int, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    raised = [failure]
    if not isinstance(failure, OSError):
        raised.append(ExceptionGroup("daemon", [ExceptionGroup("tasks", [failure])]))
    for one in raised:
        monkeypatch.setattr(root, "run", fails_with(one))
        ran = slipguard(capfd, "run", "--sim")
        assert ran.complaint.startswith(line)
        assert ran.code == code


def test_an_internal_error_is_not_hidden(capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    both = ExceptionGroup("daemon", [ConfigError("x"), ValueError("a mistake")])
    monkeypatch.setattr(root, "run", fails_with(both))
    with pytest.raises(ExceptionGroup):
        slipguard(capfd, "run", "--sim")


def test_a_cell_without_an_arm_needs_guard_mode(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    path = tmp_path / "cell.toml"
    text = (Path(__file__).parents[3] / "config.toml").read_text().replace('driver = "ur5"', 'driver = "none"')
    text = "\n".join(line for line in text.splitlines() if not line.startswith(("[arm.ur5]", *UR5_KEYS)))
    path.write_text(text)
    ran = slipguard(capfd, "check", "--config", path)
    assert 'set mode = "guard"' in ran.complaint
    path.write_text(text.replace('mode = "lift"', 'mode = "guard"'))
    ran = slipguard(capfd, "check", "--config", path)
    assert ran.code == 0
    assert "no arm: only the grip is guarded" in ran.out
