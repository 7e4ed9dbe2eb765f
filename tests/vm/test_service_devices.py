"""The service's unit under a real kernel: devices whose modules are loaded after its start may be opened."""

from __future__ import annotations

from pathlib import Path

import pytest
from machine import Machine

pytestmark = pytest.mark.vm
UNIT = (Path(__file__).parents[2] / "systemd" / "slipguard.service").read_text()
WITHOUT_MODULES = "\n".join(line for line in UNIT.splitlines() if "modprobe@" not in line)


@pytest.mark.parametrize(
    ("unit", "camera", "adapter"),
    [
        pytest.param(UNIT, "opened", "ENXIO", id="as-installed"),  # no adapter is plugged in, but the kernel is asked
        pytest.param(WITHOUT_MODULES, "EPERM", "EPERM", id="without-modprobe"),
    ],
)
def test_devices_that_appear_after_the_start_may_be_opened(
    unit: str, camera: str, adapter: str, systemd_machine: Machine
) -> None:
    seen = systemd_machine.play("units:modules_after_the_start", unit=unit)
    assert not {"video4linux", "ttyUSB"} & set(seen["before"]), "the modules were loaded before the start"
    assert (seen["camera"], seen["adapter"]) == (camera, adapter)
