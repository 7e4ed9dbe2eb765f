"""The virtual machine, booted once for all tests here. `python tests/vm/build_image.py --install` builds it."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

sys.path.append(str(Path(__file__).parent))

from build_image import image_folder
from machine import Machine

VARIABLE = "SLIPGUARD_VM"


@pytest.fixture(scope="session")
def machine() -> Iterator[Machine]:
    """Boot the image that SLIPGUARD_VM names, or the one that `build_image.py` has built."""
    image = Path(os.environ.get(VARIABLE) or image_folder())
    assert (image / "root.ext4").exists(), (
        f"no image in {image}; build it with `python tests/vm/build_image.py --install`"
    )
    machine = Machine(image)
    yield machine
    machine.stop()
