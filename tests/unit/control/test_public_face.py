"""The library by itself: the example of `slipguard.control` runs."""

from __future__ import annotations

import doctest

import slipguard.control


def test_the_example_runs() -> None:
    found = doctest.testmod(slipguard.control, optionflags=doctest.ELLIPSIS)
    assert found.attempted > 5
    assert found.failed == 0
