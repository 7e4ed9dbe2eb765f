"""A pydantic complaint as one line a person can act on: key, value, what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticCustomError

_AT_KEY = "at_key"
_FOLLOWS = "default_factory_not_called"
"""Of a key that is not given and takes its value from one that is wrong: no problem of its own."""
_SHOWN_MAX = 80
_PLAIN_BELOW = 1e5
"""A number below this is shown without a fraction it does not have."""


def first_complaint(error: ValidationError, model: type[BaseModel] | None = None, *, under: str = "") -> str:
    """The first problem of a validation error; how many more there are is said at the end.

    model: what was validated; if given, the keys there are stand beside an unknown one. under: the key of the table
    that was validated. A value is shown as TOML spells it; a table or a long list is not shown in full.
    """
    problems = [problem for problem in error.errors(include_url=False) if problem["type"] != _FOLLOWS]
    more = f" ({len(problems) - 1} more after this one)" if len(problems) > 1 else ""
    return _one(problems[0], model, under) + more


def at_key(key: str, given: object, allowed: str) -> PydanticCustomError:
    """What a check of a whole table raises: which of its keys is to be changed, its value, what is allowed.

    given: None where the key is not there.
    """
    return PydanticCustomError(_AT_KEY, "{key}: {allowed}", {"key": key, "given": given, "allowed": allowed})


def shown(given: object) -> str:
    """A value in one short line."""
    if isinstance(given, bool):
        return str(given).lower()
    if isinstance(given, Mapping | BaseModel):
        return "a table"
    text = f"{given:g}" if isinstance(given, float) and abs(given) < _PLAIN_BELOW else repr(given)
    return text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}…"


def no_such_key(unknown: str, known: list[str]) -> str:
    """What to say of a key that is none, beside those there are."""
    near = difflib.get_close_matches(unknown, known, n=1)
    if near:
        return f"no such key; did you mean {near[0]!r}?"
    return "no such key" + (f"; there are: {', '.join(known)}" if known else "")


def _one(problem: Any, model: type[BaseModel] | None, under: str) -> str:
    path = ([under] if under else []) + [str(part) or '""' for part in problem["loc"]]
    key = ".".join(path) or "the table"
    kind, given, context = problem["type"], problem["input"], problem.get("ctx", {})
    if kind == _AT_KEY:
        there = "" if context["given"] is None else f" = {shown(context['given'])}"
        return f"{'.'.join([*path, context['key']])}{there}: {context['allowed']}"
    if kind == "extra_forbidden":
        known = _keys_beside(problem["loc"], model) if model is not None else []
        return f"{key}: {no_such_key(path[-1], known)}"
    if kind == "missing":
        return f"{key}: missing; it must be given"
    message = str(context.get("error", problem["msg"]))
    value = "" if isinstance(given, Mapping | BaseModel) else f" = {shown(given)}"
    return f"{key}{value}: {message[:1].lower()}{message[1:]}"


def _keys_beside(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """The keys allowed where an unknown one stands."""
    for part in location[:-1]:
        inner = model.model_fields[str(part)].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return [name for name in model.model_fields if name != "settings"]
