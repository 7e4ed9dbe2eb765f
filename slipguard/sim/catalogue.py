"""All simulated objects by name: those for training networks and those for testing, from `objects.toml`."""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from slipguard.errors import InputError
from slipguard.sim import shapes
from slipguard.sim.raster import Field, f32
from slipguard.sim.sim_object import SimObject

_PLACED = ("box", "dimples", "disc", "knurl", "path", "polygon", "rays", "regular", "sphere")
"""Functions of shapes.py whose first arguments are u and v."""
_OF_SHAPES = ("arc", "cylinder", "grooves", "highest", "inside", "lowered", "plateau", "ridge", "union", "without")
_OF_NUMPY = ("arange", "arcsin", "arctan2", "clip", "cos", "hypot", "pi", "sin", "sqrt", "tanh")
_WORDS: dict[str, Any] = {
    "__builtins__": {"zip": zip}, "abs": np.abs, "max": np.maximum, "min": np.minimum,
    **{name: getattr(shapes, name) for name in _OF_SHAPES},
    **{name: getattr(np, name) for name in _OF_NUMPY},
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class HeightFormula:
    """A height map. parts: (name, formula) in the order in which they use each other, the last one is the height."""

    parts: tuple[tuple[str, str], ...]

    def __call__(self, u: Field, v: Field) -> Field:
        """Return the heights at u (right) and v (up), mm, float32 arrays of one shape."""
        words = _WORDS | {name: partial(getattr(shapes, name), u, v) for name in _PLACED} | {"u": u, "v": v}
        for name, formula in self.parts:
            words[name] = eval(formula, words)  # a file of this package, not of a user
        return f32(words["height"])


def _object(name: str, table: dict[str, Any]) -> SimObject:
    known = {field.name for field in fields(SimObject)}
    parts = tuple((key, text) for key, text in table.items() if key not in known)
    return SimObject(name, height_mm=HeightFormula(parts), **{key: table[key] for key in table if key in known})


_TABLES = tomllib.loads((Path(__file__).parent / "objects.toml").read_text(encoding="utf-8"))
_OBJECTS = {name: _object(name, table) for name, table in _TABLES.items()}


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
