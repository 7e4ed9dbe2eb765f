"""Commands of other programs in the documentation: what they name exists here, and fits the files that they use."""

from __future__ import annotations

import json
import re
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path

import pytest
from documentation import FILES, code, each_file, shell_steps
from sandbox import ROOT
from test_readme import COMMAND, check

from slipguard.daemon.journal import render_entry
from slipguard.installation import PLACES, SHIPPED_EXECUTABLE, UNIT
from slipguard.thread_priority import FIRST
from slipguard.web.sockets import SOCKET_GROUP

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
DOCKERFILE = (ROOT / "Dockerfile").read_text(encoding="utf-8").replace("\\\n", " ")
UNIT_TEXT = (ROOT / "systemd" / UNIT).read_text(encoding="utf-8")
SERVICE = UNIT.removesuffix(".service")
IMAGE = "slipguard"
WITH_VALUE = ("--cap-add", "--device", "--entrypoint", "--name", "--network", "--ulimit", "-v")
"""Options of `docker run` that take a value."""
CHECKED_BY = {
    "ros2": "drivers/slipguard_ros/test/test_documentation.py",
    "rviz2": "drivers/slipguard_ros/test/test_documentation.py",
    "colcon": "drivers/slipguard_ros/test/test_documentation.py",
    "slipguard_node": "drivers/slipguard_ros/test/test_documentation.py",
    "slipguard_to_rosbag": "drivers/slipguard_ros/test/test_documentation.py",
    "lerobot-record": "drivers/lerobot_robot_slipguard/test/test_documentation.py",
}
"""Programs whose commands are checked where their packages are installed."""
OF_THE_SYSTEM = ("apt-get", "cd", "source", "kill")
"""Not checked: they name nothing of this project."""


def _check_pip(words: list[str], folder: Path) -> None:
    assert words[0] == "install", f"pip {words[0]}"
    for word in (one for one in words[1:] if not one.startswith("-") and not one.isupper()):
        name, _, extras = word.rstrip("]").partition("[")
        package = ROOT if name == PROJECT["project"]["name"] else ROOT / name
        if (package / "pyproject.toml").exists():
            text = "".join(file.read_text() for file in (*package.glob("pyproject.toml"), *package.glob("setup.py")))
            for extra in filter(None, extras.split(",")):
                assert re.search(rf'^\s*"?{extra}"?\s*[=:] \[', text, re.M), f"{name} has no extra {extra}"
        else:
            assert f"'{word}" in (ROOT / ".ci" / "run").read_text(), (
                f"{word}: neither a folder nor installed by .ci/run"
            )


def _check_python(words: list[str], folder: Path) -> None:
    if words[0] == "-m":
        assert words[1] in ("venv", "pytest"), words[1]
        return
    assert (ROOT / words[0]).exists() or (folder / words[0]).exists(), words[0]


def _check_systemctl(words: list[str], folder: Path) -> None:
    verb, *rest = words
    names = [word for word in rest if word != "--now"]
    assert verb in ("enable", "restart", "reload", "status", "edit"), f"systemctl {verb}"
    assert names in ([], [SERVICE]), names
    assert PLACES[UNIT].name == f"{SERVICE}.service", "installed under another name"
    assert verb != "enable" or "[Install]\nWantedBy=" in UNIT_TEXT
    assert verb != "reload" or "\nExecReload=" in UNIT_TEXT


def _check_journalctl(words: list[str], folder: Path) -> None:
    assert words[:2] == ["-u", SERVICE], words
    _check_journal_filter(words[2:])


def _check_journal_filter(words: list[str]) -> None:
    if words[:1] == ["-p"]:
        assert words[1] in ("emerg", "alert", "crit", "err", "warning", "notice", "info", "debug")
    for field, _, value in (word.partition("=") for word in words if "=" in word):
        entry = render_entry(None, "error", {"event": value})
        assert f"{field}={value}\n".encode() in entry, f"no entry has the field {field}"


def _check_adduser(words: list[str], folder: Path) -> None:
    assert words[1:] == [SOCKET_GROUP]


def _check_mkdocs(words: list[str], folder: Path) -> None:
    assert (ROOT / words[words.index("-f") + 1]).exists()


def _check_copy(words: list[str], folder: Path) -> None:
    assert (ROOT / next(word for word in words if not word.startswith("-"))).exists()


def _check_configured(tool: str) -> Callable[[list[str], Path], None]:
    def check_tool(words: list[str], folder: Path) -> None:
        assert tool in PROJECT["tool"], f"pyproject.toml does not configure {tool}"

    return check_tool


def _check_docker(words: list[str], folder: Path) -> None:
    verb, *rest = words
    if verb == "build":
        assert rest[:2] == ["-t", IMAGE]
        assert (ROOT / rest[2] / "Dockerfile").exists()
    elif verb == "exec":
        assert rest[0] in container_names(), f"no documented container is named {rest[0]}"
        _check_inside(rest[1:])
    else:
        assert verb == "run", verb
        _check_run(rest)


def container_names() -> set[str]:
    """Return the names that the documentation gives to containers."""
    text = "".join(path.read_text(encoding="utf-8") for path in FILES)
    return set(re.findall(r"docker run[^`]* --name (\S+)", text.replace("\\\n", " ")))


def _check_run(words: list[str]) -> None:
    """Check `docker run`: its options, and the command that runs in the container."""
    options: dict[str, list[str]] = {}
    while words[0].startswith("-"):
        option = words.pop(0)
        if option in WITH_VALUE:
            options.setdefault(option, []).append(words.pop(0))
        else:
            assert option in ("--init", "--rm"), f"docker run {option}"
    image, *command = words
    assert image == IMAGE, f"the image {image} is not built; documented: docker build -t {IMAGE}"
    for device in options.get("--device", ()):
        kind = {"video": "video4linux"}.get(found := re.sub(r"/dev/|\d+$", "", device), found)
        assert f"DeviceAllow=char-{kind} " in UNIT_TEXT, f"the service does not use {device}"
    places = [volume.split(":")[1] for volume in options.get("-v", ())]
    for place in places:
        assert place in (f"/{PLACES['config.toml'].parent}", environment("STATE_DIRECTORY")), place
    if "--entrypoint" in options:
        assert [options["--entrypoint"][0], *command[:2]] == ["chrt", "--rr", f"{FIRST}"]
        assert f"rtprio={FIRST}" in options["--ulimit"]
        command = command[2:]
    else:
        command = [*instruction("ENTRYPOINT"), *(command or instruction("CMD"))]
    _check_inside(command)


def _check_inside(command: list[str]) -> None:
    assert command[0] == Path(SHIPPED_EXECUTABLE).name
    check("slipguard", shlex.join(command[1:]))


def instruction(name: str) -> list[str]:
    """Return the words of an instruction in the Dockerfile."""
    (found,) = re.findall(rf"^{name} (\[.*\])$", DOCKERFILE, re.M)
    return list(json.loads(found))


def environment(name: str) -> str:
    """Return a variable of the Dockerfile's last stage."""
    (found,) = re.findall(rf"^ENV .*\b{name}=(\S+)", DOCKERFILE, re.M)
    return str(found)


CHECKS: dict[str, Callable[[list[str], Path], None]] = {
    "adduser": _check_adduser,
    "cp": _check_copy,
    "docker": _check_docker,
    "journalctl": _check_journalctl,
    "mkdocs": _check_mkdocs,
    "mutmut": _check_configured("mutmut"),
    "mypy": _check_configured("mypy"),
    "lint-imports": _check_configured("importlinter"),
    "pip": _check_pip,
    "python": _check_python,
    "ruff": _check_configured("ruff"),
    "systemctl": _check_systemctl,
}
KNOWN = re.compile(rf"(?:sudo |\w+=\S+ )*(?:[\w./]*/)?({'|'.join((*CHECKS, *CHECKED_BY))})[\d.]* ")


def run_check(step: str, folder: Path) -> None:
    """Check one command; folder: that of the text with it. Raises if it names what does not exist."""
    words = shlex.split(step)
    while words[0] == "sudo" or re.fullmatch(r"\w+=\S+", words[0]):
        words.pop(0)
    name = re.sub(r"(?<=python)[\d.]+$", "", Path(words[0]).name)
    if name in CHECKED_BY:
        text = (ROOT / CHECKED_BY[name]).read_text(encoding="utf-8")
        assert re.search(rf"\b{name}\b", text), f"`{step}`: {CHECKED_BY[name]} does not check {name}"
    elif name not in OF_THE_SYSTEM:
        assert name in CHECKS, f"`{step}`: no check for {name}"
        CHECKS[name](words[1:], folder)


@each_file
def test_commands_of_other_programs_name_what_exists(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    steps = {*filter(KNOWN.match, code(text)), *shell_steps(text)}
    for step in sorted(one for one in steps if not COMMAND.match(one)):
        run_check(step, path.parent)
    for words in re.findall(r"`(SLIPGUARD_\w+=\w+|-p \w+)`", text):
        _check_journal_filter(words.split())


@pytest.mark.parametrize(
    "wrong",
    [
        "sudo systemctl restart slip-guard",
        "systemctl relaod slipguard",
        "journalctl -u slipguard SLIPGUARD_KIND=fault",
        "docker build -t slipguard docker/",
        "docker run --rm slip",
        "docker run --device /dev/ttyS0 slipguard",
        "docker run -v /run/slip:/run/slip slipguard",
        "docker run slipguard run --konfig config.toml",
        "docker exec guard slipguard ctl state",
        "pip install 'drivers/slipguard_ros[jazzy]'",
        "pip install drivers/slipguard_ros2",
        "sudo adduser NAME plugdev",
        "python drivers/slipguard_ros/test/restart_campain.py",
        "cp -r drivers/slipguard_ros2 ws/src/",
        "mkdocs serve -f mkdocs.yml",
        "snap install slipguard",
    ],
)
def test_a_wrong_name_is_detected(wrong: str) -> None:
    with pytest.raises(BaseException, match=r"(?s).+"):
        run_check(wrong, ROOT)


def test_the_release_workflow_names_what_exists() -> None:
    text = (ROOT / ".github" / "workflows" / "release.yml").read_text(encoding="utf-8")
    (script,) = re.findall(r"- run: (\S+) dist ", text)
    assert (ROOT / script).stat().st_mode & 0o100, f"{script} cannot be executed"
    assert not re.findall(r"^\s*(?:context|file|target):", text, re.M), "the image is built from the Dockerfile here"
    assert all(re.search(r"@[0-9a-f]{40} # v", line) for line in text.splitlines() if "uses:" in line)
    stages = re.findall(r"^FROM \S+ AS (\S+)", DOCKERFILE, re.M)
    assert set(re.findall(r"--from=(\S+)", DOCKERFILE)) <= set(stages)
