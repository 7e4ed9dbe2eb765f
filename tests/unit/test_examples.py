"""The examples in the docstrings of `slipguard.perception` and `slipguard.control` give what they say."""

from __future__ import annotations

import doctest
import importlib
import pkgutil

import pytest

import slipguard.control
import slipguard.perception

PACKAGES = (slipguard.perception, slipguard.control)
MODULES = [
    *(package.__name__ for package in PACKAGES),
    *(one.name for package in PACKAGES for one in pkgutil.walk_packages(package.__path__, f"{package.__name__}.")),
]


@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_are_right(name: str) -> None:
    flags = doctest.NORMALIZE_WHITESPACE | doctest.ELLIPSIS
    failed, _ = doctest.testmod(importlib.import_module(name), optionflags=flags)
    assert failed == 0
