"""What is in the wheel, and that it works from a folder of its own."""

from __future__ import annotations

import json
import tomllib
import zipfile
from pathlib import Path

import pytest
from sandbox import ROOT, Sandbox

from slipguard.registry import GROUPS

SUMMARY = {
    "lifts", "held", "dropped", "refused", "turn_error_lifts", "turn_error_mean_deg", "turn_error_worst_object_deg",
    "true_turn_median_deg", "true_turn_max_deg", "true_slip_median_deg", "true_slip_max_deg",
    "over_20_deg_or_dropped", "latency_p50_ms", "latency_p99_ms",
    "skipped_share", "deadlines_missed",
}  # fmt: skip


@pytest.fixture(scope="module")
def names(wheel: Path) -> set[str]:
    with zipfile.ZipFile(wheel) as archive:
        return set(archive.namelist())


def test_wheel_contains_the_three_packages_and_nothing_else(names: set[str]) -> None:
    version = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    tops = {name.split("/")[0] for name in names}
    assert tops == {"slipguard", "slipguard_drivers", "slipguard_emulators", f"slipguard-{version}.dist-info"}


def test_every_module_of_the_checkout_is_in_it(names: set[str]) -> None:
    wanted = {
        f"{package.name}/{path.relative_to(package).as_posix()}"
        for package in (
            ROOT / "slipguard",
            *(ROOT / "drivers" / name for name in ("slipguard_drivers", "slipguard_emulators")),
        )
        for path in package.rglob("*.py")
    }
    assert wanted <= names


def test_the_networks_are_in_it_and_no_test_or_image(names: set[str]) -> None:
    endings = {Path(name).suffix for name in names if not name.split("/")[0].endswith(".dist-info")}
    page = {".html", ".css", ".js", ".svg"}
    assert endings - page == {".py", ".typed", ".onnx", ".service", ".rules", ".toml"}
    networks = {
        "tsnn-small.onnx",
        "peer-deeplabv3plus-resnet18-timing.onnx",
    }  # the paper's own is too large for a wheel
    assert {name for name in names if name.endswith(".onnx")} == {f"slipguard/models/{name}" for name in networks}
    assert not any(Path(name).name.startswith("test_") or "conftest" in name or "tests" in name for name in names)


def test_it_is_the_installed_one_that_runs(installed_sandbox: Sandbox, installed: Path) -> None:
    where = (
        "import slipguard, slipguard_drivers; "
        "from slipguard.perception.segmenter import default_model_path as model; "
        "print(slipguard.__file__, slipguard_drivers.__file__, model(), sep='\\n')"
    )
    done = installed_sandbox.run("-c", where)
    assert done.returncode == 0, done.stderr
    assert all(Path(line).is_relative_to(installed) for line in done.stdout.splitlines())
    assert "models" in done.stdout.splitlines()[2]


def test_version_and_check(installed_sandbox: Sandbox) -> None:
    done = installed_sandbox.run("-m", "slipguard", "version", "--json")
    assert done.returncode == 0, done.stderr
    facts = json.loads(done.stdout)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert facts["slipguard"] == project["version"]
    assert facts["drivers"] == {
        group: sorted(points) for group, points in project["entry-points"].items() if group in GROUPS
    }
    config = str(ROOT / "config.toml")
    done = installed_sandbox.run("-m", "slipguard", "check", "--config", config, vendor=True)
    assert done.returncode == 0, done.stderr
    assert "the configuration is valid" in done.stdout
    done = installed_sandbox.run("-m", "slipguard", "check", "--config", config)
    assert done.returncode in (0, 2)
    assert "Traceback" not in done.stderr
    assert installed_sandbox.left_behind == []


@pytest.mark.campaign
def test_a_lift_with_vendor_libraries_and_network_blocked_leaves_only_its_picture(installed_sandbox: Sandbox) -> None:
    done = installed_sandbox.run(
        "-m", "slipguard", "--sim", "--lifts", "1", "--speed", "fast", "--json", "--out", "pictures"
    )
    assert done.returncode == 0, done.stderr
    lines = [json.loads(line) for line in done.stdout.splitlines()]
    assert set(lines[-1]["summary"]) == SUMMARY
    assert lines[-1]["summary"]["held"] == 1
    left = [path.relative_to(installed_sandbox.path).as_posix() for path in installed_sandbox.left_behind]
    assert left == ["work/pictures", "work/pictures/guarded.png"]
