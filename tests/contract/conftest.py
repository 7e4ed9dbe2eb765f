"""The contract suites run on the fakes, and on the real drivers against the doubles in `tests/wire`."""

from __future__ import annotations

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parents[1] / "wire"))
