"""The state directory: files are complete or absent, older images are kept, damage is reported."""

from __future__ import annotations

import contextlib
import json
import os
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from slipguard.control.state import Adoption
from slipguard.daemon.store.background_images import BackgroundImage
from slipguard.daemon.store.last_grasp import restore_control_state
from slipguard.daemon.store.last_reference import ReferenceStore
from slipguard.daemon.store.state_dir import KEPT, LastGrasp, StateDir, default_state_path
from slipguard.errors import ConfigError, InputError, SlipguardError
from slipguard.perception.stored_reference import StoredReference


def no_contact(level: int = 90) -> BackgroundImage:
    rng = np.random.default_rng(level)
    image = rng.integers(level, level + 40, (320, 240, 3), dtype=np.uint8)
    return BackgroundImage(image, (2.9, 1.5, 2.4), 30)


def test_a_stored_background_is_loaded_unchanged(tmp_path: Path) -> None:
    state = StateDir(tmp_path / "new" / "state")
    assert state.load_background("D20479") is None
    assert state.background_created_at("D20479") is None
    taken = no_contact()
    state.save_background("D20479", taken)
    known = state.load_background("D20479")
    assert known is not None
    np.testing.assert_array_equal(known.image, taken.image)
    assert known.noise_bgr == taken.noise_bgr
    assert known.frames == 30
    assert not known.image.flags.writeable
    created = state.background_created_at("D20479")
    assert created is not None
    assert abs(datetime.now(UTC) - created) < timedelta(minutes=1)


def test_the_newest_background_is_used_and_older_ones_stay(tmp_path: Path) -> None:
    state = StateDir(tmp_path)
    for level in (50, 90, 130):
        state.save_background("D20479", no_contact(level))
    known = state.load_background("D20479")
    assert known is not None
    np.testing.assert_array_equal(known.image, no_contact(130).image)
    names = sorted(entry.name for entry in (tmp_path / "sensors" / "D20479").iterdir())
    assert names == [f"no_contact-{n:04d}.{kind}" for n in (1, 2, 3) for kind in ("json", "png")]
    assert state.load_background("D20480") is None


def test_an_image_without_its_json_is_not_used(tmp_path: Path) -> None:
    """What a crash between the two files leaves."""
    state = StateDir(tmp_path)
    state.save_background("D20479", no_contact(50))
    folder = tmp_path / "sensors" / "D20479"
    (folder / "no_contact-0002.png").write_bytes(b"half a pict")
    known = state.load_background("D20479")
    assert known is not None
    np.testing.assert_array_equal(known.image, no_contact(50).image)


@pytest.mark.parametrize("keep", [0, 20, 1000])
def test_a_damaged_image_is_an_error_with_its_name(tmp_path: Path, keep: int) -> None:
    state = StateDir(tmp_path)
    state.save_background("D20479", no_contact())
    png = tmp_path / "sensors" / "D20479" / "no_contact-0001.png"
    png.write_bytes(png.read_bytes()[:keep])
    with pytest.raises(InputError, match=r"no_contact-0001\.png: .*sha256.*slipguard calibrate") as caught:
        state.load_background("D20479")
    assert "\n" not in str(caught.value)


NO_ZONE = (
    '{"serial": "D20479", "created_at": "2026-01-01T00:00:00", "noise_bgr": [1, 1, 1], "frames": 30, "sha256": "0"}'
)


@pytest.mark.parametrize("text", ["", "{", "[]", '{"format": 2}', '{"format": 1, "serial": "D20479"}', NO_ZONE])
def test_a_damaged_json_is_an_error_with_its_name(tmp_path: Path, text: str) -> None:
    state = StateDir(tmp_path)
    state.save_background("D20479", no_contact())
    (tmp_path / "sensors" / "D20479" / "no_contact-0001.json").write_text(text)
    with pytest.raises(InputError, match=r"no_contact-0001\.json: damaged") as caught:
        state.load_background("D20479")
    assert "\n" not in str(caught.value)


def test_a_folder_of_images_that_cannot_be_read_is_an_error_with_its_name(tmp_path: Path) -> None:
    (tmp_path / "sensors").mkdir()
    (tmp_path / "sensors" / "D20479").symlink_to("D20479")
    with pytest.raises(InputError, match=r"sensors/D20479: cannot be read \(Too many levels of symbolic links\)"):
        StateDir(tmp_path).load_background("D20479")


@contextlib.contextmanager
def no_access(folder: Path) -> Iterator[None]:
    """As if the folder belonged to another user; root becomes one meanwhile."""
    is_root = os.geteuid() == 0
    folder.chmod(0)
    if is_root:
        os.seteuid(65534)
    try:
        yield
    finally:
        if is_root:
            os.seteuid(0)
        folder.chmod(0o700)


def test_another_users_folder_is_reported_and_does_not_say_that_nothing_was_held(tmp_path: Path) -> None:
    state, references = StateDir(tmp_path / "state"), ReferenceStore(tmp_path / "state" / "references")
    state.save_background("D20479", no_contact())
    state.save_last_grasp(LastGrasp(saved_at=datetime.now(UTC), force_n=40.0, width_mm=18.0))
    references.save("left", "D20479", StoredReference(no_contact().image, 0.0, 0.0))
    lines: list[str] = []
    with no_access(tmp_path / "state"):
        assert restore_control_state(state, warning=lines.append).grasp.adoption == Adoption(outdated=True)
        for read in (state.load_background, state.background_versions, state.first_of_gel):
            with pytest.raises(InputError, match="cannot be read"):
                read("D20479")
        with pytest.raises(InputError, match="cannot be read"):
            references.load("left", "D20479")
        with pytest.raises(SlipguardError, match="Permission denied"):
            state.save_background("D20479", no_contact())
    assert [line.count("cannot be read (Permission denied)") for line in lines] == [1]
    assert restore_control_state(state).grasp.adoption.remembered is not None, "the file is as it was"


@pytest.mark.parametrize("serial", ["", "../up", "a/b", ".hidden", "x" * 65, "D20479\n"])
def test_a_serial_number_cannot_contain_a_path(tmp_path: Path, serial: str) -> None:
    with pytest.raises(InputError, match="serial number"):
        StateDir(tmp_path).load_background(serial)


def test_an_image_of_another_size_is_not_stored(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="320, 240"):
        StateDir(tmp_path).save_background("D1", BackgroundImage(np.zeros((10, 10, 3), np.uint8), (1.0, 1.0, 1.0), 1))


def test_a_failed_write_leaves_the_old_file_intact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    state = StateDir(tmp_path)
    before = LastGrasp(saved_at=datetime.now(UTC), force_n=40.0, width_mm=18.0)
    state.save_last_grasp(before)

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(ConfigError, match="No space left"):
        state.save_last_grasp(before.model_copy(update={"force_n": 90.0}))
    monkeypatch.undo()
    assert state.load_last_grasp() == before
    assert [entry.name for entry in tmp_path.iterdir()] == ["last_grasp.json"]


def test_the_last_grasp_can_be_deleted_and_damage_is_an_error(tmp_path: Path) -> None:
    state = StateDir(tmp_path)
    assert state.load_last_grasp() is None
    state.delete_last_grasp()
    state.save_last_grasp(LastGrasp(saved_at=datetime.now(UTC), force_n=40.0, width_mm=18.0))
    state.delete_last_grasp()
    assert state.load_last_grasp() is None
    (tmp_path / "last_grasp.json").write_text('{"force_n": "NaN"}')
    with pytest.raises(InputError, match=r"last_grasp\.json: damaged"):
        state.load_last_grasp()


def test_a_folder_that_is_not_writable_is_an_error_with_its_name(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match=r"cannot be written .*\[state\] directory"):
        StateDir(tmp_path / "file" / "state").save_background("D1", no_contact())


def test_default_state_directory(tmp_path: Path) -> None:
    assert default_state_path({"STATE_DIRECTORY": "/var/lib/slipguard:/x", "HOME": "/h"}) == Path("/var/lib/slipguard")
    assert default_state_path({"XDG_STATE_HOME": "/s", "HOME": "/h"}) == Path("/s/slipguard")
    assert default_state_path({"HOME": "/h"}) == Path("/h/.local/state/slipguard")
    assert StateDir(tmp_path, {}).runtime_path == tmp_path
    assert StateDir(tmp_path, {"RUNTIME_DIRECTORY": "/run/slipguard"}).runtime_path == Path("/run/slipguard")


def test_each_image_is_a_version_with_its_time_noise_and_light(tmp_path: Path) -> None:
    state = StateDir(tmp_path)
    assert state.background_versions("D20479") == []
    for level in (50, 60):
        state.save_background("D20479", no_contact(level))
    first, second = state.background_versions("D20479")
    assert (first.number, second.number) == (1, 2)
    assert first.created_at <= second.created_at
    assert first.noise_bgr == no_contact(50).noise_bgr
    assert second.level_bgr is not None
    assert second.level_bgr[0] - first.level_bgr[0] == pytest.approx(10.0, abs=0.5)  # type: ignore[index]


def test_restoring_an_older_image_adds_a_copy_and_deletes_nothing(tmp_path: Path) -> None:
    state = StateDir(tmp_path)
    for level in (50, 60):
        state.save_background("D20479", no_contact(level))
    state.restore_background("D20479", 1)
    newest = state.load_background("D20479")
    assert newest is not None
    np.testing.assert_array_equal(newest.image, no_contact(50).image)
    history = state.background_versions("D20479")
    assert [(one.number, one.copy_of) for one in history] == [(1, None), (2, None), (3, 1)]
    assert history[2].created_at == history[0].created_at
    other = state.load_background("D20479", 2)
    assert other is not None
    np.testing.assert_array_equal(other.image, no_contact(60).image)
    with pytest.raises(InputError, match=r"D20479: background image 9 not found; stored numbers: 1, 2, 3"):
        state.restore_background("D20479", 9)


def test_the_oldest_images_are_deleted_except_the_first_of_the_gel(tmp_path: Path) -> None:
    state = StateDir(tmp_path)
    for number in range(KEPT + 5):
        state.save_background("D20479", no_contact(50 + number), new_gel=number == 2)
    numbers = [one.number for one in state.background_versions("D20479")]
    assert numbers == [3, *range(6, KEPT + 6)]
    first = state.first_of_gel("D20479")
    assert first is not None
    np.testing.assert_array_equal(first.image, no_contact(52).image)
    assert len(list((tmp_path / "sensors" / "D20479").iterdir())) == 2 * len(numbers)


def test_files_without_version_data_are_read(tmp_path: Path) -> None:
    state = StateDir(tmp_path)
    state.save_background("D20479", no_contact())
    path = tmp_path / "sensors" / "D20479" / "no_contact-0001.json"
    facts = json.loads(path.read_text())
    for key in ("level_bgr", "new_gel", "copy_of"):
        del facts[key]
    path.write_text(json.dumps(facts))
    (version,) = state.background_versions("D20479")
    assert (version.level_bgr, version.new_gel, version.copy_of) == (None, False, None)
    assert state.first_of_gel("D20479") is not None


@pytest.mark.parametrize(
    ("content", "problem"), [(b'{"format": 5, "fo', "EOF while parsing"), (b"", "EOF"), (b"\0" * 9, "")]
)
def test_a_file_that_is_cut_off_or_overwritten_is_not_valid_json(tmp_path: Path, content: bytes, problem: str) -> None:
    (tmp_path / "last_grasp.json").write_bytes(content)
    with pytest.raises(InputError, match=rf"last_grasp\.json: damaged: not valid JSON: {problem}"):
        StateDir(tmp_path).load_last_grasp()
