"""The test machine: booted once for all tests here, left out with a word where it has not been built."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from deselection import leave_out

sys.path.append(str(Path(__file__).parent))

from build_image import image_folder
from machine import Machine

VARIABLE = "SLIPGUARD_VM"


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Without an image, and where nobody asks for it, the tests of the machine are deselected."""
    if os.environ.get(VARIABLE) or (image_folder() / "root.ext4").exists():
        return
    leave_out(
        config,
        items,
        "vm",
        "of the DIGIT driver on a real kernel were left out: no test machine has been built; "
        "`python tests/vm/build_image.py --install` builds it (root, apt and two minutes)",
    )


@pytest.fixture(scope="session")
def machine() -> Iterator[Machine]:
    """Booted; SLIPGUARD_VM names another image than the usual one, and one that is missing is a failure."""
    image = Path(os.environ.get(VARIABLE) or image_folder())
    assert (image / "root.ext4").exists(), f"no image in {image}; build it with `python tests/vm/build_image.py`"
    machine = Machine(image)
    yield machine
    machine.stop()
