"""`slipguard ctl` with a served daemon."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path

import pytest
from fake_daemon_api import TOKEN, FakeDaemonApi, served, served_on_tcp
from typer.testing import CliRunner

from slipguard.cli.ctl import app
from slipguard.daemon.api import paths
from slipguard.daemon.api.requests import (
    ActivateRequest,
    CalibrateRequest,
    ClearRequest,
    DaemonRequest,
    GraspRequest,
    GuardRequest,
    LiftRequest,
    LowerRequest,
    MoveJawsRequest,
    ReleaseRequest,
    StopRequest,
)
from slipguard.errors import CommandRefused, InputError, SlipguardError


@pytest.fixture
def daemon() -> FakeDaemonApi:
    return FakeDaemonApi()


async def ctl(daemon: FakeDaemonApi, folder: Path, *words: str, typed: str | None = None) -> tuple[int, str]:
    """Exit code and output of one command; errors of slipguard come through."""
    async with served(daemon, folder / "s") as path:
        line = [words[0], "--socket", str(path), *words[1:]]
        result = await asyncio.to_thread(CliRunner().invoke, app, line, input=typed)
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


COMMANDS: list[tuple[list[str], DaemonRequest]] = [
    (["grasp", "--force-n", "30"], GraspRequest(force_n=30)),
    (["lift", "--height-mm", "120", "--speed-mm-s", "20"], LiftRequest(height_mm=120, speed_mm_s=20)),
    (["lower"], LowerRequest()),
    (["stop"], StopRequest()),
    (["guard", "on"], GuardRequest(on=True)),
    (["guard", "off"], GuardRequest(on=False)),
    (["gripper", "--width-mm", "60"], MoveJawsRequest(width_mm=60)),
    (["release", "--yes"], ReleaseRequest(confirm=True)),
    (["activate", "--yes"], ActivateRequest(confirm=True)),
    (["activate", "--yes", "--force"], ActivateRequest(confirm=True, force=True)),
    (["clear"], ClearRequest()),
    (["calibrate", "--force"], CalibrateRequest(force=True)),
    (["calibrate", "--new-gel"], CalibrateRequest(new_gel=True)),
]


@pytest.mark.parametrize(("words", "submitted"), COMMANDS, ids=lambda value: " ".join(map(str, value)))
async def test_commands(words: list[str], submitted: DaemonRequest, daemon: FakeDaemonApi, tmp_path: Path) -> None:
    code, output = await ctl(daemon, tmp_path, *words)
    assert code == 0
    assert daemon.requests == [submitted]
    assert output.count("\n") == 1
    code, output = await ctl(daemon, tmp_path, *words, "--json")
    assert code == 0
    assert "message" in json.loads(output)


async def test_state_as_table_and_as_json(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    _, output = await ctl(daemon, tmp_path, "state")
    assert "holding" in output
    assert "gripped" in output
    _, output = await ctl(daemon, tmp_path, "state", "--json")
    assert json.loads(output) == daemon.snapshot()


async def test_a_release_needs_confirmation(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    code, _ = await ctl(daemon, tmp_path, "release", typed="n\n")
    assert code == 1
    assert daemon.requests == []
    code, output = await ctl(daemon, tmp_path, "release", typed="")
    assert code == 1
    assert "not done" in output
    assert daemon.requests == []
    code, _ = await ctl(daemon, tmp_path, "release", typed="y\n")
    assert code == 0
    assert daemon.requests == [ReleaseRequest(confirm=True)]


async def test_an_activation_says_what_it_does_and_needs_confirmation(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    for typed in ("n\n", ""):
        code, output = await ctl(daemon, tmp_path, "activate", typed=typed)
        assert (code, daemon.requests) == (1, [])
        assert "full speed and force" in output
        assert "Take the gels off" in output
        assert "not done" in output
    code, _ = await ctl(daemon, tmp_path, "activate", typed="y\n")
    assert (code, daemon.requests) == (0, [ActivateRequest(confirm=True)])


async def test_the_fingertips_are_measured_with_empty_jaws_only(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    assert (await ctl(daemon, tmp_path, "fingertips", typed="n\n"))[0] == 1
    with pytest.raises(
        CommandRefused, match="the jaws must be empty, and the phase is holding; support what they hold"
    ):
        await ctl(daemon, tmp_path, "fingertips", "--yes")
    assert daemon.requests == []


async def test_a_refusal_is_raised(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    daemon.failure = CommandRefused("cannot lift while idle")
    with pytest.raises(CommandRefused, match="cannot lift while idle"):
        await ctl(daemon, tmp_path, "lift")


async def over_tcp(folder: Path, daemon: FakeDaemonApi, *words: str, token: str | None = TOKEN) -> tuple[int, str]:
    """Exit code and output of one command over TCP; errors of slipguard come through."""
    async with served_on_tcp(daemon, folder) as (port, _):
        line = ["--url", f"http://127.0.0.1:{port}"]
        if token is not None:
            (folder / "given").write_text(token + "\n")
            line += ["--token-file", str(folder / "given")]
        result = await asyncio.to_thread(CliRunner().invoke, app, [*line, *words])
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    return result.exit_code, result.output


@pytest.fixture
def nowhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """This user's runtime folder; empty, and no daemon of the system."""
    own = tmp_path / "own"
    own.mkdir()
    monkeypatch.setenv("RUNTIME_DIRECTORY", str(own))
    monkeypatch.setattr(paths, "SYSTEM_FOLDER", tmp_path / "system")
    return own


async def test_commands_over_tcp(daemon: FakeDaemonApi, nowhere: Path, tmp_path: Path) -> None:
    assert (await over_tcp(tmp_path, daemon, "lift", "--height-mm", "30"))[0] == 0
    assert (await over_tcp(tmp_path, daemon, "state"))[0] == 0
    with pytest.raises(SlipguardError, match="this request needs the token"):
        await over_tcp(tmp_path, daemon, "release", "--yes", token="0" * 64)
    with pytest.raises(SlipguardError, match="this request needs the token"):
        await over_tcp(tmp_path, daemon, "release", "--yes", token=None)
    (nowhere / "token").write_text(TOKEN + "\n")
    assert await over_tcp(tmp_path, daemon, "clear", token=None) == (0, "clear: done\n")
    assert daemon.requests == [LiftRequest(height_mm=30), ClearRequest()]


async def test_a_link_to_the_page(daemon: FakeDaemonApi, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    opened: list[str] = []
    monkeypatch.setattr(os, "geteuid", lambda: 1000)
    monkeypatch.setattr("webbrowser.open", lambda url: opened.append(url) or True)
    _, output = await over_tcp(tmp_path, daemon, "page")
    assert output.startswith("http://127.0.0.1:")
    assert "/login?token=" in output
    assert opened == []
    _, output = await over_tcp(tmp_path, daemon, "page", "--open")
    assert opened == [output.strip()]
    monkeypatch.setattr("webbrowser.open", lambda url: False)
    with pytest.raises(SlipguardError, match="no browser"):
        await over_tcp(tmp_path, daemon, "page", "--open")
    with pytest.raises(CommandRefused, match="page is not served"):
        await ctl(daemon, tmp_path, "page")


def test_root_opens_no_browser(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr("webbrowser.open", lambda url: pytest.fail("a browser was started"))
    result = CliRunner().invoke(app, ["page", "--open"])
    assert isinstance(result.exception, InputError)
    assert "open the link in your own browser" in str(result.exception)


def test_conflicting_or_invalid_addresses_are_refused() -> None:
    for line, why in (
        (["--url", "http://127.0.0.1:1", "--socket", "s", "state"], "cannot be combined"),
        (["--url", "http://127.0.0.1:1", "state", "--socket", "s"], "cannot be combined"),
        (["--token-file", "t", "state"], "--token-file needs --url"),
        (["--url", "http://127.0.0.1:1", "--token-file", "/nowhere/t", "state"], "cannot be read"),
        (["--url", "127.0.0.1:1", "state"], "is not a daemon address"),
        (["--url", "http://", "state"], "is not a daemon address"),
        (["--url", "http://[::1", "state"], "is not a daemon address"),
        (["--url", "http://127.0.0.1:1", "state"], "no daemon is listening at http"),
    ):
        result = CliRunner().invoke(app, line)
        assert isinstance(result.exception, SlipguardError), (line, result)
        assert why in str(result.exception), line


def test_the_default_token_is_only_sent_to_this_machine(nowhere: Path) -> None:
    (nowhere / "token").write_text("secret\n")
    assert paths.token_for("http://127.0.0.1:8470") == "secret"
    assert paths.token_for("http://[::1]:8470") == "secret"
    assert paths.token_for("http://localhost:8470") == "secret"
    for foreign in ("http://192.0.2.7:8470", "http://127.0.0.1.evil.example:8470", "http://evil.example"):
        assert paths.token_for(foreign) is None


async def test_the_socket_option_is_accepted_before_the_command(daemon: FakeDaemonApi, tmp_path: Path) -> None:
    async with served(daemon, tmp_path / "s") as path:
        result = await asyncio.to_thread(CliRunner().invoke, app, ["--socket", str(path), "clear"])
    assert (result.exit_code, result.output) == (0, "clear: done\n")
