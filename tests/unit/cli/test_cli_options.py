"""Options that the documentation shows and no other test uses, each in a short run."""

from __future__ import annotations

import importlib.util
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from slipguard.cli import evaluate
from slipguard.cli.app import run
from slipguard.control.messages import HoldForce, StepOutput
from slipguard.errors import SlipguardError
from slipguard.tools import replay as lab

EMULATED = {
    "cell": (
        *("--folder", "cell", "--object", "wrench", "--mode", "guard", "--fault", "gripper.late:0.01"),
        *("--host", "127.0.0.92", "--json"),
    ),
    "digit": ("--serial", "D20001", "--pixels", "MJPG", "--fault", "corrupt:0.01", "--port", "0", "--json"),
    "ur": ("--host", "127.0.0.93", "--series", "cb3", "--fault", "freeze:0.01", "--json"),
}


@pytest.mark.parametrize("emulator", EMULATED)
def test_emulate(emulator: str, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "slipguard", "emulate", emulator, *EMULATED[emulator]]
    with subprocess.Popen(
        words, cwd=tmp_path, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as running:
        output, complaint = running.communicate("quit\n", timeout=60.0)
    assert (running.returncode, complaint) == (0, "")
    assert any("ready" in json.loads(line) for line in output.splitlines())
    if emulator == "cell":
        assert 'mode = "guard"' in (tmp_path / "cell" / "config.toml").read_text()


@pytest.mark.parametrize(("differs", "code"), [(True, 1), (False, 0)])
def test_replay_against_fails_if_commands_differ(
    differs: bool, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    requested: list[object] = []
    other = [lab.CommandDifference(1.0, StepOutput(), StepOutput(HoldForce(50.0)))] if differs else []

    def played(opened: object, model: Path | None) -> lab.ReplayResult:
        requested.append(model)
        return lab.ReplayResult(on_recorded=lab.ControllerReplay(3, len(other), other))

    monkeypatch.setattr(lab, "recordings", lambda files: files)
    monkeypatch.setattr(lab, "replay", played)
    assert run(["replay", "kept", "--against"]) == code
    assert ("force_n=50.0" in capsys.readouterr().out) is differs
    assert run(["replay", "kept", "--model", "other.onnx"]) == 1
    assert "no frame was processed, so the network was not used" in capsys.readouterr().err
    assert requested == [None, Path("other.onnx")]


@pytest.mark.parametrize(
    "words", [("dataset", "render", "--count", "2", "--cluster"), ("bench", "--grip", "--full", "--cluster")]
)
def test_a_cluster_that_does_not_respond(
    words: tuple[str, ...], tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    assert run([*words, "nowhere://x", "--out", str(tmp_path / "out")]) == 2
    why = "nowhere://x" if importlib.util.find_spec("distributed") else "slipguard[cluster]"
    assert why in capfd.readouterr().err


def test_evaluate_on_a_cell_opens_camera_and_intrinsics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    requested: list[tuple[object, ...]] = []

    def on_cell(*received: object) -> None:
        requested.append(received)
        raise SlipguardError("that was enough")

    monkeypatch.setattr(evaluate, "_run_on_cell", on_cell)
    (tmp_path / "protocol.toml").write_text('objects = [{name = "spanner"}]\n')
    files: list[Any] = ["--config", "config.toml", "--protocol", tmp_path / "protocol.toml", "--out", tmp_path / "eval"]
    words = ["evaluate", "run", *files, "--camera", "4", "--intrinsics", "camera.json"]
    assert run([str(word) for word in words]) == 1
    assert requested[0][0] == tmp_path / "eval"
    assert requested[0][2:] == (Path("config.toml"), "4", Path("camera.json"))


def test_import_skips_incomplete_pairs(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    drawn = np.full((320, 240, 3), 90, np.uint8)
    for name in ("images/a.png", "images/b.png", "masks/a.png"):
        path = tmp_path / "in" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(path), cv2.circle(drawn[..., 0] * 0, (60, 80), 40, 255, -1) if "masks" in name else drawn)
    words = ["dataset", "import", str(tmp_path / "in"), "--out", str(tmp_path / "out")]
    assert run(words) == 2
    assert "use --skip" in capfd.readouterr().err
    assert run([*words, "--skip"]) == 0
    assert capfd.readouterr().out.startswith("1 frame")
