"""The campaign that writes the table of the model card."""

from pathlib import Path

import pytest

from tests.campaigns.command_line import run


def test_a_page_without_markers_is_not_changed(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    page = tmp_path / "page.md"
    page.write_text("no markers\n")
    assert run(["bench-table", str(page)]) == 2
    assert "page.md" in capfd.readouterr().err
    assert page.read_text() == "no markers\n"
