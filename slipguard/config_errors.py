"""Describe a pydantic validation error in one line: key, value, what is allowed."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError
from pydantic_core import PydanticCustomError

_AT_KEY = "at_key"
_FOLLOWS = "default_factory_not_called"
"""Type of the error of a missing key whose default depends on a wrong key; it is not reported."""
_UNKNOWN_KEY = "extra_forbidden"
_SHOWN_MAX = 80
_SHORT_BELOW = 1e5
"""A whole number below this is shown without a fraction."""


def describe_problems(error: ValidationError, model: type[BaseModel] | None = None, *, under: str = "") -> list[str]:
    """Return a description, in one line, of each problem of a validation error.

    An unknown key comes first: a key with a typo leaves another one missing or at its default.

    Args:
        error: The validation error.
        model: The validated model; with it, an unknown key is shown with the known ones.
        under: The key of the validated table.
    """
    problems = [problem for problem in error.errors(include_url=False) if problem["type"] != _FOLLOWS]
    problems.sort(key=lambda problem: problem["type"] != _UNKNOWN_KEY)
    return [_describe_problem(problem, model, under) for problem in problems]


def describe_validation_error(error: ValidationError, model: type[BaseModel] | None = None, *, under: str = "") -> str:
    """Return the likeliest cause of a validation error and the number of further problems, in one line."""
    first, *others = describe_problems(error, model, under=under)
    return first + (f" ({len(others)} more after this one)" if others else "")


def error_at_key(key: str, given: object, allowed: str) -> PydanticCustomError:
    """Return the error that the check of a table raises for one of its keys.

    given: The key's value; None if it is missing. allowed: What is allowed.
    """
    return PydanticCustomError(_AT_KEY, "{key}: {allowed}", {"key": key, "given": given, "allowed": allowed})


def format_value(given: object) -> str:
    """Return a value as TOML spells it, shortened to one line; a table is not shown."""
    if isinstance(given, bool):
        return str(given).lower()
    if isinstance(given, Mapping | BaseModel):
        return "a table"
    text = f"{given:g}" if isinstance(given, float) and abs(given) < _SHORT_BELOW else repr(given)
    return text if len(text) <= _SHOWN_MAX else f"{text[:_SHOWN_MAX]}…"


def describe_unknown_key(unknown: str, known: list[str]) -> str:
    """Return the message for an unknown key, with the nearest or all known keys."""
    near = difflib.get_close_matches(unknown, known, n=1)
    if near:
        return f"no such key; did you mean {near[0]!r}?"
    return "no such key" + (f"; known keys: {', '.join(known)}" if known else "")


def _describe_problem(problem: Any, model: type[BaseModel] | None, under: str) -> str:
    path = ([under] if under else []) + [str(part) or '""' for part in problem["loc"]]
    key = ".".join(path) or "the table"
    kind, given, context = problem["type"], problem["input"], problem.get("ctx", {})
    if kind == _AT_KEY:
        there = "" if context["given"] is None else f" = {format_value(context['given'])}"
        return f"{'.'.join([*path, context['key']])}{there}: {context['allowed']}"
    if kind == _UNKNOWN_KEY:
        known = _known_keys(problem["loc"], model) if model is not None else []
        return f"{key}: {describe_unknown_key(path[-1], known)}"
    if kind == "missing":
        return f"{key}: missing; it must be given"
    if kind == "json_invalid":
        return f"not valid JSON: {context['error']}"
    message = str(context.get("error", problem["msg"]))
    value = "" if isinstance(given, Mapping | BaseModel) else f" = {format_value(given)}"
    return f"{key}{value}: {message[:1].lower()}{message[1:]}"


def _known_keys(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """Return the keys that are known at a location."""
    for part in location[:-1]:
        inner = model.model_fields[str(part)].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return [name for name in model.model_fields if name != "settings"]
