"""DIGITs are found by their serial number in a copy of the kernel's /sys."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from slipguard.errors import DeviceLost
from slipguard_drivers.digit.discovery import DigitDevice, connected_digits, find_digit


class Sysfs:
    """Cameras as the kernel shows them: class links to nodes below the interface of a USB device."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.folder = root / "class" / "video4linux"
        self.folder.mkdir(parents=True)
        self._nodes = 0

    def plug(self, port: str, serial: str, vendor: str = "2833", product: str = "0209", release: str = "0212") -> None:
        usb = self.root / "devices" / "usb1" / port
        interface = usb / f"{port}:1.0"
        interface.mkdir(parents=True)
        facts = {"idVendor": vendor, "idProduct": product, "serial": serial, "bcdDevice": release, "speed": "480"}
        for name, value in facts.items():
            (usb / name).write_text(value + "\n")
        for index in (0, 1):
            node = interface / "video4linux" / f"video{self._nodes}"
            node.mkdir(parents=True)
            (node / "index").write_text(f"{index}\n")
            (node / "device").symlink_to(interface)
            (self.folder / node.name).symlink_to(node)
            self._nodes += 1


@pytest.fixture
def sysfs(tmp_path: Path) -> Sysfs:
    return Sysfs(tmp_path)


def test_a_digit_is_found_by_its_serial(sysfs: Sysfs) -> None:
    sysfs.plug("1-1", "D20002")
    sysfs.plug("1-4.2", "D20001", release="0199")
    sysfs.plug("2-1", "WEBCAM", vendor="046d")
    assert connected_digits(sysfs.folder, Path("/dev")) == [
        DigitDevice(Path("/dev/video2"), "D20001", 199, "1-4.2", 480.0),
        DigitDevice(Path("/dev/video0"), "D20002", 212, "1-1", 480.0),
    ]
    found = find_digit("D20001", "left", sysfs.folder)
    assert (found.path.name, found.bus, found.has_rgb) == ("video2", "1", False)
    assert find_digit("D20002", "left", sysfs.folder).has_rgb


@pytest.mark.parametrize(("serials", "expected"), [(["D20001", "D20002"], "only D20001, D20002; "), ([], "USB cable")])
def test_a_missing_sensor_is_reported_with_the_connected_ones(sysfs: Sysfs, serials: list[str], expected: str) -> None:
    for port, serial in enumerate(serials, 1):
        sysfs.plug(f"1-{port}", serial)
    with pytest.raises(DeviceLost, match=expected):
        find_digit("D2", "left", sysfs.folder)


def test_a_device_unplugged_during_the_check_is_not_found(sysfs: Sysfs) -> None:
    sysfs.plug("1-1", "D20001")
    for file in (sysfs.root / "devices" / "usb1" / "1-1").glob("id*"):
        file.unlink()
    assert connected_digits(sysfs.folder) == []


def test_without_any_camera_none_is_found(tmp_path: Path) -> None:
    assert connected_digits(tmp_path / "nowhere") == []


def test_an_unreadable_firmware_number_counts_as_new(sysfs: Sysfs) -> None:
    sysfs.plug("1-1", "D20001", release="02a0")
    (found,) = connected_digits(sysfs.folder)
    assert found.firmware is None
    assert found.has_rgb


def test_a_camera_unplugged_during_discovery_is_skipped(sysfs: Sysfs, monkeypatch: pytest.MonkeyPatch) -> None:
    """Between two steps of following its links the kernel takes them away."""
    sysfs.plug("1-1", "D20001")
    sysfs.plug("1-2", "D20002")
    readlink = os.readlink

    def unplugged(path: str | Path) -> str:
        if str(path).endswith("1-1:1.0/video4linux/video0/device"):
            raise FileNotFoundError(path)
        return readlink(path)

    monkeypatch.setattr(os, "readlink", unplugged)
    assert [one.serial for one in connected_digits(sysfs.folder)] == ["D20002"]
