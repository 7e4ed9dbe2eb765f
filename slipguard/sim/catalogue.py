"""All simulated objects by name: those for training networks and those for testing."""

from __future__ import annotations

from slipguard.errors import InputError
from slipguard.sim import catalogue_test, catalogue_train
from slipguard.sim.sim_object import SimObject

_OBJECTS = {item.name: item for item in (*catalogue_train.OBJECTS, *catalogue_test.OBJECTS)}


def find_object(name: str) -> SimObject:
    """Return the object of that name; raise InputError, listing the names, if there is none."""
    found = _OBJECTS.get(name)
    if found is None:
        raise InputError(f"no object {name!r}; there are: {', '.join(sorted(_OBJECTS))}")
    return found


def object_names(split: str) -> tuple[str, ...]:
    """Return the names of the "train" or "test" objects in a fixed order; raise InputError for another split."""
    if split not in ("train", "test"):
        raise InputError(f"no split {split!r}; there are: train, test")
    return tuple(item.name for item in _OBJECTS.values() if item.split == split)
