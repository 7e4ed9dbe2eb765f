"""Explain the keys of the configuration, from the models that check it: meaning, allowed values, default."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from slipguard.config import DEFAULT_DRIVER, GROUP_OF, Config
from slipguard.config_errors import describe_unknown_key
from slipguard.errors import InputError
from slipguard.registry import driver_names, load_driver

BOUNDS = {
    "minimum": "from {:g}",
    "exclusiveMinimum": "above {:g}",
    "maximum": "to {:g}",
    "exclusiveMaximum": "below {:g}",
}


def explain_key(key: str) -> Iterator[str]:
    """Yield lines that explain one key, such as `guard.margin`, or all keys of a table. Raises InputError."""
    model: type[BaseModel] = Config
    parts = key.split(".")
    for depth, part in enumerate(parts):
        inner = _tables(model, parts[:depth])
        if part in inner:
            model = inner[part]
        elif part in model.model_fields and part != "settings" and depth == len(parts) - 1:
            yield from _explain(key, part, model)
            return
        else:
            known = [name for name in (*model.model_fields, *inner) if name != "settings"]
            raise InputError(f"--explain {key}: {part}: {describe_unknown_key(part, sorted(set(known)))}")
    yield f"[{key}] {' '.join((model.__doc__ or '').split())}"
    for name in model.model_fields:
        if name not in ("settings", *_tables(model, parts)):
            yield from _explain(f"{key}.{name}", name, model)
    for name in _tables(model, parts):
        yield f"[{key}.{name}]: see `slipguard check --explain {key}.{name}`"


def _tables(model: type[BaseModel], path: list[str]) -> Mapping[str, type[BaseModel]]:
    """Return the tables inside a table; in a device's section those of the installed drivers."""
    inner = {
        name: field.annotation
        for name, field in model.model_fields.items()
        if isinstance(field.annotation, type) and issubclass(field.annotation, BaseModel) and name != "settings"
    }
    if len(path) == 1 and path[0] in GROUP_OF:
        group = GROUP_OF[path[0]]
        first = DEFAULT_DRIVER[path[0]]
        names = sorted(driver_names(group), key=lambda name: name != first)
        inner |= {name: load_driver(group, name).Settings for name in names}
    return inner


def _explain(key: str, name: str, model: type[BaseModel]) -> Iterator[str]:
    """Yield one line: the key with its default, its meaning, and what is allowed."""
    field = model.model_json_schema()["properties"][name]
    default = field.get("default")
    spelled = "unset" if default is None else json.dumps(default)
    head = f"{key} (required)" if model.model_fields[name].is_required() else f"{key} = {spelled}"
    meaning = " ".join(field.get("description", "").split())
    allowed = ", ".join(_allowed(field))
    yield ": ".join(filter(None, (head, meaning))) + (f" [{allowed}]" if allowed else "")


def _allowed(field: Mapping[str, Any]) -> Iterator[str]:
    """Yield what is allowed, in words, from a JSON schema."""
    for choice in field.get("anyOf", [field]):
        yield from (f'"{one}"' if isinstance(one, str) else f"{one}" for one in choice.get("enum", ()))
        bounds = [text.format(choice[name]) for name, text in BOUNDS.items() if name in choice]
        if bounds:
            yield " ".join(bounds)
