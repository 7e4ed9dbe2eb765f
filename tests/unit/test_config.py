"""A wrong configuration is one line: the key, the value, what is allowed."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from slipguard.config import parse_config, read_config, sim_config
from slipguard.errors import ConfigError

SHIPPED = Path(__file__).parents[2] / "config.toml"


def complaint(raw: dict[str, Any], *, sim: bool = True) -> str:
    with pytest.raises(ConfigError) as caught:
        parse_config(raw, where="c.toml", sim=sim)
    text = str(caught.value)
    assert "\n" not in text
    assert text.startswith("c.toml: ")
    return text


def test_the_shipped_file_is_fine_and_complete() -> None:
    config = read_config(SHIPPED)
    assert (config.left.driver, config.gripper.driver, config.arm.driver) == ("digit", "robotiq", "ur5")
    text = SHIPPED.read_text()
    for section in ("guard", "perception", "loop", "api", "state"):
        for key in getattr(config, section).__class__.model_fields:
            assert f"{key} = " in text, f"config.toml does not explain {section}.{key}"
        assert getattr(config, section) == type(getattr(config, section))(), f"[{section}] differs from the defaults"


def test_sim_replaces_all_four_drivers() -> None:
    config = read_config(SHIPPED, sim=True)
    assert [getattr(config, name).driver for name in ("left", "right", "gripper", "arm")] == ["fake"] * 4
    assert sim_config().left.driver == "fake"


def test_a_typo_names_the_nearest_key() -> None:
    assert "guard.first_forse_n: no such key; did you mean 'first_force_n'?" in complaint(
        {"guard": {"first_forse_n": 3}}
    )
    assert "left.rotation: no such key; did you mean 'rotation_deg'?" in complaint({"left": {"rotation": 0}})


def test_a_typo_in_a_drivers_table_names_that_table() -> None:
    text = complaint({"left": {"driver": "fake", "fake": {"drow": "inline"}}})
    assert "left.fake.drow: no such key; did you mean 'draw'?" in text


@pytest.mark.parametrize(
    ("raw", "expected"),
    [
        ({"guard": {"first_force_n": "much"}}, "guard.first_force_n = 'much'"),
        ({"guard": {"first_force_n": float("nan")}}, "guard.first_force_n = nan"),
        ({"guard": {"force_max_n": 1e9}}, "guard.force_max_n = 1000000000.0"),
        ({"left": {"rotation_deg": 45}}, "left.rotation_deg = 45"),
        ({"left": 7}, "left = 7: a table is needed, [left]"),
        ({"left": {"driver": 5}}, "left.driver = 5"),
        ({"left": {"settings": {}}}, "left.settings: no such key"),
        ({"loop": {"period_ms": 0}}, "loop.period_ms = 0"),
        ({"perception": {"estimator": "magic"}}, "perception.estimator = 'magic'"),
        ({"unknown": 1}, "unknown: no such key"),
    ],
)
def test_a_wrong_value_is_shown_with_its_key(raw: dict[str, Any], expected: str) -> None:
    assert expected in complaint(raw)


def test_an_unknown_driver_lists_those_there_are() -> None:
    text = complaint(
        {name: {"driver": "fake"} for name in ("left", "right", "arm")} | {"gripper": {"driver": "robotik"}}, sim=False
    )
    assert "gripper.driver = 'robotik'" in text
    assert "fake, robotiq" in text


@pytest.mark.parametrize("content", [b"a = ", b"\xff\xfe", b"[left"])
def test_an_unreadable_file_says_so(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "c.toml"
    path.write_bytes(content)
    with pytest.raises(ConfigError, match=r"c\.toml"):
        read_config(path)


def test_a_missing_file_and_a_folder_say_so(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no such file"):
        read_config(tmp_path / "none.toml")
    with pytest.raises(ConfigError, match="cannot be read"):
        read_config(tmp_path)


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
def test_addresses_to_listen_at(listen: str, address: tuple[str, int] | None) -> None:
    config = parse_config({"api": {"listen": listen}}, where="test", sim=True)
    assert config.api.address == address


@pytest.mark.parametrize(
    "listen", ["8470", ":8470", "127.0.0.1", "127.0.0.1:0", "127.0.0.1:65536", "cell:8470", "1.2.3.4:+5"]
)
def test_addresses_that_are_none(listen: str) -> None:
    with pytest.raises(ConfigError, match=r"api\.listen = .*(by number|port after)"):
        parse_config({"api": {"listen": listen}}, where="test", sim=True)
