"""A pydantic complaint as one line a person can act on: key, value, what is allowed."""

from __future__ import annotations

import difflib
from typing import Any

from pydantic import BaseModel, ValidationError


def first_complaint(error: ValidationError, model: type[BaseModel] | None = None) -> str:
    """The first problem of a validation error; how many more there are is said at the end.

    model: what was validated; if given, the keys there are stand beside an unknown one.
    """
    problems = error.errors(include_url=False)
    more = f" ({len(problems) - 1} more after this one)" if len(problems) > 1 else ""
    return _one(problems[0], model) + more


def _one(problem: Any, model: type[BaseModel] | None) -> str:
    key = ".".join(str(part) for part in problem["loc"]) or "the table"
    kind, given = problem["type"], problem["input"]
    if kind == "extra_forbidden":
        known = _keys_beside(problem["loc"], model) if model is not None else []
        near = difflib.get_close_matches(str(problem["loc"][-1]), known, n=1)
        if near:
            return f"{key}: no such key; did you mean {near[0]!r}?"
        return f"{key}: no such key" + (f"; there are: {', '.join(known)}" if known else "")
    if kind == "missing":
        return f"{key}: missing; it must be given"
    message = str(problem.get("ctx", {}).get("error", problem["msg"]))
    return f"{key} = {given!r}: {message[0].lower()}{message[1:]}"


def _keys_beside(location: tuple[int | str, ...], model: type[BaseModel]) -> list[str]:
    """The keys allowed where an unknown one stands."""
    for part in location[:-1]:
        inner = model.model_fields[str(part)].annotation
        if not (isinstance(inner, type) and issubclass(inner, BaseModel)):
            return []
        model = inner
    return [name for name in model.model_fields if name != "settings"]
