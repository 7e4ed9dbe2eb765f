"""Fuzzing in short form, and that it would notice what it looks for."""

from __future__ import annotations

import json
from pathlib import Path
from random import Random

import pytest

from slipguard.errors import InputError
from tests.campaigns import fuzz_cases
from tests.campaigns.command_line import run
from tests.campaigns.fuzz import FuzzResult, fuzz, run_kind
from tests.campaigns.fuzz_cases import KINDS, changed_bytes, changed_value, run_case


@pytest.mark.campaign
@pytest.mark.parametrize("kind", KINDS)
def test_damaged_inputs_are_one_line(kind: str, capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    assert run(["fuzz", kind, "--cases", "40", "--json", "--keep", str(tmp_path)]) == 0, list(tmp_path.iterdir())
    found = json.loads(capfd.readouterr().out)[kind]
    assert found["cases"] == 40
    assert len(found["outcomes"]) > 1, "some are refused, and some are not"


def test_a_case_depends_on_its_number_and_the_seed_alone() -> None:
    def made(seed: int) -> list[object]:
        draw = Random(seed)
        return [changed_bytes(draw, b"0123456789" * 9), str(changed_value(draw, {"a": [1, 2.0, {"b": "c"}]}))]

    assert made(3) == made(3)
    assert len({str(made(seed)) for seed in range(20)}) > 15


@pytest.mark.parametrize(
    ("raised", "outcome", "failure"),
    [
        (ValueError("a mistake"), "ValueError", "ValueError: a mistake ("),
        (MemoryError(), "MemoryError", "MemoryError: "),
        (SystemExit(3), "SystemExit", "SystemExit: 3"),
        (None, "7", "exit code 7"),
    ],
)
def test_an_unexpected_end_is_a_failure_and_its_input_is_kept(
    raised: BaseException | None, outcome: str, failure: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(draw: Random, folder: Path) -> int:
        (folder / "input").write_text("hostile")
        if raised is not None:
            raise raised
        return 7

    monkeypatch.setitem(fuzz_cases.KINDS, "image", fails)
    found = run_case("image", 0, 5, tmp_path, tmp_path / "kept")
    assert (found["number"], found["outcome"]) == (5, outcome)
    assert found["failure"].startswith(failure)
    assert (tmp_path / "kept" / "image-0-5" / "input").read_text() == "hostile"


def test_a_crash_is_a_failure_and_the_next_case_follows() -> None:
    found = run_kind("image", 2, "no number", 10, None, lambda share: None)  # type: ignore[arg-type]
    assert found.failures == ["case 10: the process crashed or hung (1)", "case 11: the process crashed or hung (1)"]


@pytest.mark.parametrize(
    ("found", "failure"),
    [
        (FuzzResult("image", 9, memory_mb=299.0), None),
        (FuzzResult("image", 9, memory_mb=301.0), "image: 301 MB of memory (limit 300 MB)"),
        (FuzzResult("image", 9, failures=["case 3: x"]), "image: 1 of 9 cases failed; the first: case 3: x"),
    ],
)
def test_failures_and_memory_are_judged(found: FuzzResult, failure: str | None) -> None:
    assert found.failure == failure


def test_an_unknown_kind_is_refused() -> None:
    assert run(["fuzz", "imagge"]) == 2
    with pytest.raises(InputError, match="imagge: no such kind; choose from configuration"):
        fuzz(["imagge"])
