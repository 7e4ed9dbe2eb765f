"""The configuration in use is kept, and is used at a start on which the file is not valid."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from slipguard.config import Config, file_content, parse_config, read_config
from slipguard.daemon.store.last_config import read_or_last
from slipguard.errors import ConfigError

SHIPPED = Path(__file__).parents[3] / "config.toml"


def invalid() -> Config:
    raise ConfigError("config.toml: guard.forse: no such key")


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    path = tmp_path / "last_config.json"
    path.write_text(json.dumps(file_content(read_config(SHIPPED))))
    return path


def test_the_content_of_a_configuration_is_read_back_as_the_same_configuration() -> None:
    config = read_config(SHIPPED)
    stored = json.loads(json.dumps(file_content(config)))
    assert parse_config(stored, where="test") == config


def test_with_an_invalid_file_the_last_configuration_is_used_and_both_are_named(kept: Path) -> None:
    config, problem = read_or_last(invalid, kept)
    assert config == read_config(SHIPPED)
    assert problem is not None
    assert problem.startswith("config.toml: guard.forse: no such key. NOT in use: the service runs with its last valid")
    assert problem.endswith("Correct the file, then `systemctl reload slipguard`")


UNUSABLE = [None, "", "{", "[]", "7", "[" * 100_000, "9" * 5000, '{"gaurd": {}}', '{"left": {"driver": "gone"}}']


@pytest.mark.parametrize("content", UNUSABLE)
def test_without_a_usable_last_configuration_the_files_error_is_reported(content: str | None, kept: Path) -> None:
    if content is None:
        kept.unlink()
    else:
        kept.write_text(content)
    with pytest.raises(ConfigError, match=r"guard\.forse: no such key"):
        read_or_last(invalid, kept)
